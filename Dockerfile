# SPDX-License-Identifier: MIT
# datagen, materials and the Blender add-on's command in one image; renders on the processor.
#   docker build --tag scene-materials .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" scene-materials datagen run demo --out rooms
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" scene-materials materials infer kitchen --out asset
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" scene-materials \
#     python -m blender_addon room.blend --out packages --license CC0-1.0
FROM python:3.11-slim-bookworm

SHELL ["/bin/bash", "-euo", "pipefail", "-c"]
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PYTHONUNBUFFERED=1

# Built from a copy that the image does not keep; the installed packages contain the bundled library.
COPY . /source
WORKDIR /source
# The CPU build of torch; the default one adds several GB of CUDA.
RUN sed --in-place 's/^torch==.*/&+cpu/' constraints.txt && \
    pip install --constraint constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu \
        '.[train,heic,raw,gltf,usd,export,blender]' && \
    VENV=/usr/local .ci/ensure_system.sh llvm && \
    VENV=/usr/local .ci/ensure_system.sh blender && \
    rm -rf /source/* /var/lib/apt/lists/*

# Kernels are cached in HOME, which any user may write.
ENV HOME=/home/user
RUN mkdir --mode=1777 /home/user
WORKDIR /work
USER 65534:65534
CMD ["datagen", "doctor"]
