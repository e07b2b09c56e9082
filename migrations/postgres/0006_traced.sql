-- What tracing took: sums of a worker's batches of a pass. Only that worker's reports touch its row
CREATE TABLE traced (
    pass_id BIGINT NOT NULL,
    worker TEXT NOT NULL,
    device TEXT NOT NULL,
    batches BIGINT NOT NULL,
    points BIGINT NOT NULL,
    rays BIGINT NOT NULL,
    trace_us BIGINT NOT NULL,
    brick_requests BIGINT NOT NULL,
    brick_misses BIGINT NOT NULL,
    read_bytes BIGINT NOT NULL,
    device_bytes BIGINT NOT NULL,
    device_us BIGINT NOT NULL,
    at BIGINT NOT NULL,
    PRIMARY KEY (pass_id, worker)
);
CREATE INDEX traced_worker ON traced (worker, at);
