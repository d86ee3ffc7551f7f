# The same steps as scripts/setup and scripts/serve: install the lock file, then the project, serve.
FROM python:3.12-slim AS build
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ \
    && rm -rf /var/lib/apt/lists/*
RUN python -m venv /opt/posematch
WORKDIR /src
COPY requirements.lock ./
# Without this, hnswlib is compiled for the building machine's CPU and may not run on another.
ENV HNSWLIB_NO_NATIVE=1
RUN /opt/posematch/bin/python -m pip install --no-cache-dir --disable-pip-version-check \
    --require-hashes --requirement requirements.lock
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY library_store library_store
COPY models models
COPY evaluation evaluation
COPY app app
RUN /opt/posematch/bin/python -m pip install --no-cache-dir --disable-pip-version-check \
    --no-deps .

FROM python:3.12-slim
RUN useradd --system --uid 10001 --create-home --home-dir /var/lib/posematch posematch \
    && install --directory --owner=posematch /var/cache/posematch
COPY --from=build /opt/posematch /opt/posematch
ENV PATH=/opt/posematch/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    POSEMATCH_HOST=0.0.0.0 \
    POSEMATCH_PORT=8000 \
    POSEMATCH_CACHE_DIR=/var/cache/posematch
# useradd above; by number, so that hosts can check that it is not root.
USER 10001
WORKDIR /var/lib/posematch
VOLUME /var/cache/posematch
EXPOSE 8000
# The first start builds the default library, which takes a minute or two. Asked without the proxy
# that Docker's own settings may put into the environment.
HEALTHCHECK --interval=10s --timeout=3s --start-period=5m --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as u; u.build_opener(u.ProxyHandler({})).open(f\"http://127.0.0.1:{os.environ['POSEMATCH_PORT']}/readyz\", timeout=2)"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["posematch"]
CMD ["serve"]
