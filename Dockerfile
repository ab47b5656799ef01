# For a CPU, ADDRESS being an index of torch's CPU builds (the common one serves CUDA builds, which are refused):
#   docker build --build-arg PIP_EXTRA_INDEX_URL=ADDRESS --tag occfusion .
# For a GPU, on any image of Debian or Ubuntu that has CUDA's compiler, for gsplat's kernels:
#   docker build --build-arg VARIANT=gpu --build-arg BASE=IMAGE --tag occfusion:gpu .
# Run folders come to lie in the folder that is mounted at /data:
#   docker run --rm --user "$(id -u)" --volume "$PWD:/data" occfusion train
ARG BASE=python:3.11-slim

FROM ${BASE} AS build
ARG VARIANT=cpu
ARG TORCH=torch==2.13.0
ARG PIP_EXTRA_INDEX_URL
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PATH=/opt/occfusion/bin:$PATH
RUN python3 -c "import ensurepip" || (apt-get update && apt-get install --yes --no-install-recommends python3-venv)
RUN python3 -m venv /opt/occfusion
RUN pip install "$TORCH" setuptools
RUN python -c "import sys, torch; found = 'gpu' if torch.version.cuda else 'cpu'; sys.exit(None if found == '$VARIANT' \
    else f'VARIANT=$VARIANT, but torch {torch.__version__} is a build for {found}: see the head of the Dockerfile')"
COPY requirements.lock /build/
RUN pip install --no-build-isolation --require-hashes --requirement /build/requirements.lock
COPY . /build
RUN if [ "$VARIANT" = gpu ]; then pip install --no-build-isolation "/build[gpu]"; \
    else pip install --no-build-isolation --no-deps --no-index /build; fi

FROM ${BASE}
RUN command -v python3 || (apt-get update && apt-get install --yes --no-install-recommends python3 python3-dev \
    && rm -rf /var/lib/apt/lists/*)
# whichever user is asked for can write results, and compiled kernels below its home
RUN useradd --uid 10001 --create-home --home-dir /home/occfusion occfusion \
    && mkdir /data && chmod 1777 /data /home/occfusion
COPY --from=build /opt/occfusion /opt/occfusion
ENV PATH=/opt/occfusion/bin:$PATH HOME=/home/occfusion PYTHONUNBUFFERED=1
USER occfusion
WORKDIR /data
ENTRYPOINT ["occfusion"]
CMD ["--help"]
