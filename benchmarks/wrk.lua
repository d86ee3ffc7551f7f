-- POST one photo again and again:
--   PHOTO=tests/data/renders/000.jpg wrk -t1 -c8 -d20s --latency -s benchmarks/wrk.lua http://127.0.0.1:8000/v1/poses

local file = assert(io.open(os.getenv("PHOTO") or "tests/data/renders/000.jpg", "rb"))
wrk.method = "POST"
wrk.body = file:read("*a")
wrk.headers["Content-Type"] = "image/jpeg"
file:close()

-- wrk's own latencies mix answers with refusals: count both.
local threads = {}

function setup(thread)
  table.insert(threads, thread)
end

function init()
  answered, refused, others = 0, 0, 0
end

function response(status)
  if status == 200 then
    answered = answered + 1
  elseif status == 503 then
    refused = refused + 1
  else
    others = others + 1
  end
end

function done(summary)
  local sums = { answered = 0, refused = 0, others = 0 }
  for _, thread in ipairs(threads) do
    for name in pairs(sums) do
      sums[name] = sums[name] + thread:get(name)
    end
  end
  print(string.format("answered %d (%.1f/s), refused %d, others %d", sums.answered,
    sums.answered / (summary.duration / 1e6), sums.refused, sums.others))
end
