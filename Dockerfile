# Images to 3D on a CPU: docker build -t gamba . && docker run --rm -v "$PWD:/work" gamba reconstruct photo.png -o out
FROM python:3.12-slim AS build
WORKDIR /source
COPY . .
# A CPU build of torch, from PyTorch's own index; pip keeps it for the rest.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN python -m venv /opt/gamba
RUN /opt/gamba/bin/pip install --no-cache-dir torch torchvision --index-url "$TORCH_INDEX"
RUN /opt/gamba/bin/pip install --no-cache-dir '.[mesh,photo,video]'

FROM python:3.12-slim
# Open3D and pymeshlab link these; nothing draws on a screen.
RUN apt-get update && apt-get install --yes --no-install-recommends \
        libegl1 libfontconfig1 libgl1 libgomp1 libopengl0 libx11-6 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/gamba /opt/gamba
# Compiled kernels are kept in the home folder, which any user of `docker run --user` may write.
RUN useradd --create-home gamba && chmod 1777 /home/gamba
USER gamba
ENV HOME=/home/gamba USER=gamba PATH=/opt/gamba/bin:$PATH
WORKDIR /work
ENTRYPOINT ["gamba"]
CMD ["--help"]
