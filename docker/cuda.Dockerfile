# scgs_warp for NVIDIA GPUs; the host needs a driver of version 580 or newer and the NVIDIA Container Toolkit.
#   docker build -f docker/cuda.Dockerfile -t scgs-warp:cuda .
#   docker run --rm -it --gpus all -v "$PWD:/work" --user "$(id -u):$(id -g)" scgs-warp:cuda train --data data/film
# torch's wheels bring CUDA's libraries, and Warp compiles the kernels with its own compiler: no CUDA image is needed.
FROM python:3.12-slim
ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 HOME=/work \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
COPY . /src
RUN pip install "/src[edit,export,gltf]"
# Compiled kernels are cached in .cache of the mounted folder, which belongs to the user of the container.
WORKDIR /work
ENTRYPOINT ["scgs-warp"]
CMD ["--help"]
