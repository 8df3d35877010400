# SymSteer on the CPU:
#
#   docker build -t symsteer .
#   docker run --rm -it -v "$PWD/runs:/symsteer/runs" symsteer make demo
#
# Chromium is for its software Vulkan driver, which renders films, and for the tests of the site.
# For CUDA, on a host with NVIDIA's container toolkit, replace the first ENV line by the second and
# give `--gpus all` to `docker run`. The pinned torch brings its own CUDA libraries.
FROM python:3.11-slim-bookworm AS tools
ENV VK_ICD_FILENAMES=/usr/lib/chromium/vk_swiftshader_icd.json
# ENV NVIDIA_DRIVER_CAPABILITIES=all
RUN apt-get update \
    && apt-get install --yes --no-install-recommends chromium git libvulkan1 make \
    && rm -rf /var/lib/apt/lists/*

FROM tools AS symsteer
WORKDIR /symsteer
# With .git: records name the commit of their code.
COPY . .
RUN make setup
ENV PATH="/symsteer/.venv/bin:$PATH"
CMD ["symsteer", "doctor"]
