# The coordinator: docker build -f deploy/coordinator.Dockerfile -t pantaray-coordinator .
FROM rust:1.95-slim-bookworm AS build
WORKDIR /source
COPY . .
# Without the GPU's code: a coordinator traces nothing
RUN cargo build --release --locked --package cli --no-default-features

FROM debian:bookworm-slim
RUN groupadd --system --gid 10001 pantaray \
    && useradd --system --uid 10001 --gid pantaray --home-dir /data --no-create-home pantaray \
    && install --directory --owner pantaray --group pantaray --mode 0700 /data
COPY --from=build /source/target/release/pantaray /usr/local/bin/pantaray
USER 10001:10001
WORKDIR /data
VOLUME /data
EXPOSE 8470
# The first signal ends it in peace: claims are refused, requests end, leases go on
STOPSIGNAL SIGTERM
# Ready: the database takes writes
HEALTHCHECK --interval=10s --timeout=3s --start-period=10s \
    CMD ["bash", "-c", "exec 3<>/dev/tcp/127.0.0.1/8470 && printf 'GET /readyz HTTP/1.0\\r\\n\\r\\n' >&3 && head -n 1 <&3 | grep -q ' 200 '"]
ENTRYPOINT ["pantaray"]
CMD ["serve", "--data", "/data", "--listen", "0.0.0.0:8470"]
