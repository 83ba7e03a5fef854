# One file for every role: ROLE is the name of a lock in requirements/ and of an extra (server, postgres, sim or dashboard).
ARG BASE=docker.io/library/python:3.11-slim-bookworm

FROM ${BASE} AS wheel
WORKDIR /src
COPY requirements/build.lock requirements/
RUN pip install --no-cache-dir --require-hashes --only-binary=:all: -r requirements/build.lock
COPY pyproject.toml README.md LICENSE ./
COPY protocol protocol
COPY learner learner
COPY client client
COPY server server
COPY sim_worker sim_worker
COPY dashboard dashboard
COPY experiments experiments
RUN pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir /wheels .

FROM ${BASE} AS environment
ARG ROLE
RUN python -m venv /opt/crkr
COPY requirements/${ROLE}.lock /opt/lock
RUN /opt/crkr/bin/pip install --no-cache-dir --require-hashes --only-binary=:all: -r /opt/lock
COPY --from=wheel /wheels /opt/wheel
RUN /opt/crkr/bin/pip install --no-cache-dir --no-deps /opt/wheel/*.whl

FROM ${BASE}
ARG ROLE
RUN if [ "${ROLE}" = sim ]; then \
      apt-get update -q && apt-get install -yq --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*; \
    fi # Pinocchio wants an OpenMP runtime
RUN useradd --uid 10001 --no-create-home --home-dir /data crkr && install -d -o crkr -g crkr /data
COPY --from=environment /opt/crkr /opt/crkr
ENV PATH=/opt/crkr/bin:$PATH PYTHONUNBUFFERED=1
USER crkr
WORKDIR /data
ENTRYPOINT ["crkr"]
CMD ["--help"]
