# dmbench without a source tree: docker build -t dmbench . && docker run --rm -v "$PWD:/work" dmbench record grid_world
# A folder that is mounted belongs to you: add --user "$(id -u):$(id -g)".
FROM python:3.11-slim AS wheel
COPY . /source
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /source

FROM python:3.11-slim
# MuJoCo draws without a screen by EGL.
RUN apt-get update \
 && apt-get install --yes --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*
# Name the index with CPU builds of PyTorch here; without it pip takes the build for GPUs, of several gigabytes.
ARG PIP_EXTRA_INDEX_URL
COPY constraints.txt /wheels/
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir --constraint /wheels/constraints.txt torch \
 && pip install --no-cache-dir --constraint /wheels/constraints.txt /wheels/*.whl \
 && useradd --create-home dmbench && mkdir /work && chown dmbench /work
ENV HOME=/tmp
USER dmbench
WORKDIR /work
ENTRYPOINT ["dmbench"]
