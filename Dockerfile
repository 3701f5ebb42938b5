# A server of searches, see docs/serve.md.
#   docker build -t kmn .
#   docker run --rm -p 127.0.0.1:8000:8000 -v "$PWD/parts:/parts:ro" kmn
# For NVIDIA GPUs: docker build --build-arg EXTRAS=serve,gpu -t kmn-gpu . and docker run --gpus all ...
ARG PYTHON=3.12
FROM python:${PYTHON}-slim-bookworm
ARG EXTRAS=serve

# What open3d and lightgbm need of the system, as in .ci/environment.
RUN apt-get update \
    && apt-get install -y -qq --no-install-recommends libusb-1.0-0 libgl1 libegl1 libx11-6 libidn2-0 libudev1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /build
COPY pyproject.toml requirements.lock README.md LICENSE NOTICE ./
COPY kmn_jax kmn_jax
# The versions of the lock, without its hashes: pip would want one of the package itself, too.
RUN sed -e 's/ *\\$//' -e '/^ *--hash=/d' requirements.lock >versions.txt \
    && pip install --no-cache-dir --constraint versions.txt ".[${EXTRAS}]"

RUN useradd --create-home kmn && mkdir /parts && install -d -o kmn /home/kmn/.cache /home/kmn/.cache/kmn_jax
WORKDIR /home/kmn
USER kmn
# Mount a volume here, and the next container compiles nothing.
ENV JAX_COMPILATION_CACHE_DIR=/home/kmn/.cache/kmn_jax
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --start-period=120s \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/health', timeout=5)"]
ENTRYPOINT ["kmn", "serve", "--host", "0.0.0.0", "--port", "8000", "--parts", "/parts"]
