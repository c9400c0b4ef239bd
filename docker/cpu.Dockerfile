# scgs_warp for CPUs. Build from the root of the repository:
#   docker build -f docker/cpu.Dockerfile -t scgs-warp:cpu .
#   docker run --rm -it -v "$PWD:/work" --user "$(id -u):$(id -g)" scgs-warp:cpu train --data data/film
FROM python:3.12-slim
ENV PIP_NO_CACHE_DIR=1 PYTHONUNBUFFERED=1 HOME=/work
COPY . /src
RUN pip install --index-url https://download.pytorch.org/whl/cpu "torch>=2.8,<2.14" \
 && pip install "/src[edit,export,gltf]"
# Compiled kernels are cached in .cache of the mounted folder, which belongs to the user of the container.
WORKDIR /work
ENTRYPOINT ["scgs-warp"]
CMD ["--help"]
