# A worker: docker build -f deploy/worker.Dockerfile -t pantaray-worker .
FROM rust:1.95-slim-bookworm AS build
WORKDIR /source
COPY . .
RUN cargo build --release --locked --package cli

FROM debian:bookworm-slim
# The loader of Vulkan drivers: a GPU's own driver comes from the host (NVIDIA's container toolkit mounts it)
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libvulkan1 \
    && rm -rf /var/lib/apt/lists/* \
    && groupadd --system --gid 10001 pantaray \
    && useradd --system --uid 10001 --gid pantaray --home-dir /cache --no-create-home pantaray \
    && install --directory --owner pantaray --group pantaray --mode 0700 /cache
COPY --from=build /source/target/release/pantaray /usr/local/bin/pantaray
USER 10001:10001
WORKDIR /cache
VOLUME /cache
# The first signal gives the batch at hand its time, and the others back
STOPSIGNAL SIGTERM
ENTRYPOINT ["pantaray"]
CMD ["worker", "--cache", "/cache"]
