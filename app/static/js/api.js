// The service as the page sees it: what it accepts, asking about a photo, the same as a curl command.

/** The service refused: `problem` is its problem+json (RFC 9457), or null when it sent none. */
export class Refusal extends Error {
  constructor(status, problem) {
    super(problem?.detail ?? `status ${status}`);
    this.status = status;
    this.problem = problem;
  }

  /** The stable part of the problem's type, such as "overloaded". */
  get slug() {
    return this.problem?.type?.split(":").at(-1) ?? "";
  }
}

/** Whoever asked waits no longer. */
export class Stopped extends Error {}

const MOST_TRIES = 4;

/** `GET v1/info`, or null when it cannot be had (not ready yet, or a key is wanted). */
export async function fetchInfo(key) {
  try {
    const response = await fetch("v1/info", { headers: keyHeader(key) });
    return response.ok ? await response.json() : null;
  } catch {
    return null;
  }
}

/**
 * Ask about a photo. A busy or starting service is asked again after the time it names.
 *
 * @param {Blob} photo the bytes as they are
 * @param {URLSearchParams} query
 * @param {{key: string, signal: AbortSignal, onWait: (seconds: number, problem: object) => void}} how
 * @returns {Promise<object>} the answer of POST /v1/poses
 * @throws {Refusal} what the service refused; TypeError when it cannot be reached
 */
export async function estimate(photo, query, { key, signal, onWait }) {
  for (let tries = 1; ; tries++) {
    const response = await fetch(`v1/poses?${query}`, {
      method: "POST",
      body: photo,
      headers: { "Content-Type": photo.type || "application/octet-stream", ...keyHeader(key) },
      signal,
    });
    if (response.ok) return response.json();
    const isProblem = response.headers.get("content-type")?.includes("json");
    const problem = isProblem ? await response.json() : null;
    const seconds = Number(response.headers.get("retry-after"));
    if (![429, 503].includes(response.status) || !(seconds <= 30) || tries === MOST_TRIES) {
      throw new Refusal(response.status, problem);
    }
    onWait(seconds, problem);
    await pause(seconds + Math.random(), signal);
  }
}

function pause(seconds, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, 1000 * seconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });
}

function keyHeader(key) {
  return key ? { "X-API-Key": key } : {};
}

/** The same question for a shell; the key's value stays out of it. */
export function curlCommand(fileName, mediaType, query, hasKey) {
  const url = new URL("v1/poses", document.baseURI);
  url.search = query;
  const parts = [
    "curl -s",
    `--data-binary @${quoted(fileName)}`,
    `-H ${quoted(`Content-Type: ${mediaType}`)}`,
    ...(hasKey ? ['-H "X-API-Key: $POSEMATCH_KEY"'] : []),
    quoted(url.href),
  ];
  return parts.join(" \\\n  ");
}

/** `text` as one word of a POSIX shell. */
function quoted(text) {
  return /^[\w.,:/=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}
