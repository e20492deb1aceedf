# AOMGen on a CPU: docker build -t aomgen . && docker run --rm -v "$PWD/out:/work/out" aomgen demo out
FROM python:3.11-slim-bookworm
RUN apt-get update \
 && apt-get install --yes --no-install-recommends build-essential cmake git libegl1 libgl1-mesa-dri make \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/aomgen
COPY . .
# A folder that every user of the container can read.
ENV AOMGEN_WEIGHTS=/opt/aomgen/weights
RUN make install
ENV PATH=/opt/aomgen/.venv/bin:$PATH
WORKDIR /work
ENTRYPOINT ["aomgen"]
