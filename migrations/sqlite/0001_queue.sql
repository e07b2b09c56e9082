-- Times are milliseconds since 1970 by the coordinator's clock. Numbers of states are those of protocol/src/states.rs.
-- Singular table names read well in joins.

CREATE TABLE project (
    name TEXT PRIMARY KEY,
    share BIGINT NOT NULL DEFAULT 100,
    running_max BIGINT
);
INSERT INTO project (name) VALUES ('default');

CREATE TABLE job (
    id TEXT PRIMARY KEY,
    project TEXT NOT NULL REFERENCES project (name),
    name TEXT NOT NULL,
    state BIGINT NOT NULL,
    paused BIGINT NOT NULL DEFAULT 0,
    reason TEXT NOT NULL DEFAULT '',
    priority BIGINT NOT NULL,
    running_max BIGINT,
    failed_max BIGINT NOT NULL DEFAULT 0,
    partial BIGINT NOT NULL DEFAULT 0,
    -- The request as it was submitted, JSON, without the scene: that is in storage
    request TEXT NOT NULL,
    -- A hash of the request, so that an idempotency key is not used for two
    request_sha256 TEXT NOT NULL,
    idempotency_key TEXT,
    shot TEXT NOT NULL DEFAULT '',
    comment TEXT NOT NULL DEFAULT '',
    frame BIGINT,
    submitted_by TEXT NOT NULL,
    resubmit_of TEXT,
    version BIGINT NOT NULL DEFAULT 1,
    created_at BIGINT NOT NULL,
    started_at BIGINT,
    ended_at BIGINT
);
CREATE INDEX job_project ON job (project, id);
CREATE INDEX job_state ON job (state, id);
CREATE INDEX job_idempotency ON job (project, idempotency_key) WHERE idempotency_key IS NOT NULL;

CREATE TABLE dependency (
    job_id TEXT NOT NULL REFERENCES job (id),
    needs TEXT NOT NULL REFERENCES job (id),
    PRIMARY KEY (job_id, needs)
);
CREATE INDEX dependency_needs ON dependency (needs);

CREATE TABLE pass (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    job_id TEXT NOT NULL REFERENCES job (id),
    kind BIGINT NOT NULL,
    -- The bake set or brick map that it is about
    name TEXT NOT NULL,
    state BIGINT NOT NULL,
    -- What to do and what was found out, JSON
    task TEXT NOT NULL,
    result TEXT,
    batch_count BIGINT NOT NULL,
    created_count BIGINT NOT NULL DEFAULT 0,
    segment_size BIGINT NOT NULL,
    reused BIGINT NOT NULL DEFAULT 0,
    created_at BIGINT NOT NULL,
    ended_at BIGINT,
    UNIQUE (job_id, kind, name)
);
CREATE INDEX pass_live ON pass (state) WHERE state <= 2;

-- A contiguous range of batches along the Hilbert curve: the unit of locality, of locking and of counting
CREATE TABLE segment (
    pass_id BIGINT NOT NULL REFERENCES pass (id),
    seg BIGINT NOT NULL,
    lo BIGINT NOT NULL,
    hi BIGINT NOT NULL,
    owner TEXT,
    owner_until BIGINT NOT NULL DEFAULT 0,
    n_ready BIGINT NOT NULL,
    n_leased BIGINT NOT NULL DEFAULT 0,
    n_done BIGINT NOT NULL DEFAULT 0,
    n_failed BIGINT NOT NULL DEFAULT 0,
    n_skipped BIGINT NOT NULL DEFAULT 0,
    ewma_ms BIGINT NOT NULL DEFAULT 0,
    not_before BIGINT NOT NULL DEFAULT 0,
    PRIMARY KEY (pass_id, seg)
) WITHOUT ROWID;

-- Narrow: no JSON, no text but the hash
CREATE TABLE batch (
    pass_id BIGINT NOT NULL,
    seq BIGINT NOT NULL,
    seg BIGINT NOT NULL,
    state BIGINT NOT NULL DEFAULT 0,
    fence BIGINT NOT NULL DEFAULT 0,
    tries BIGINT NOT NULL DEFAULT 0,
    lost BIGINT NOT NULL DEFAULT 0,
    not_before BIGINT NOT NULL DEFAULT 0,
    memory_min BIGINT NOT NULL DEFAULT 0,
    lease_id TEXT,
    sha256 TEXT,
    bytes BIGINT,
    PRIMARY KEY (pass_id, seq)
) WITHOUT ROWID;
CREATE INDEX batch_ready ON batch (pass_id, seg, seq) WHERE state = 0;
CREATE INDEX batch_lease ON batch (lease_id) WHERE lease_id IS NOT NULL;
CREATE INDEX batch_failed ON batch (pass_id, seq) WHERE state = 3;

-- Who failed at what: one row for each batch, worker and class
CREATE TABLE batch_fault (
    pass_id BIGINT NOT NULL,
    seq BIGINT NOT NULL,
    worker TEXT NOT NULL,
    class BIGINT NOT NULL,
    n BIGINT NOT NULL,
    fence BIGINT NOT NULL,
    message TEXT NOT NULL,
    first_at BIGINT NOT NULL,
    at BIGINT NOT NULL,
    PRIMARY KEY (pass_id, seq, worker, class)
);
CREATE INDEX batch_fault_worker ON batch_fault (worker, at);

CREATE TABLE lease (
    id TEXT PRIMARY KEY,
    pass_id BIGINT NOT NULL,
    seg BIGINT NOT NULL,
    worker TEXT NOT NULL,
    session TEXT NOT NULL,
    n BIGINT NOT NULL,
    granted_at BIGINT NOT NULL,
    expires_at BIGINT NOT NULL
);
CREATE INDEX lease_expiry ON lease (expires_at);
CREATE INDEX lease_worker ON lease (worker);
CREATE INDEX lease_pass ON lease (pass_id);

-- What several jobs share, such as a brick map: one pass makes it, others wait for it
CREATE TABLE artifact (
    key TEXT PRIMARY KEY,
    ready BIGINT NOT NULL DEFAULT 0,
    pass_id BIGINT NOT NULL,
    created_at BIGINT NOT NULL
);

CREATE TABLE worker (
    name TEXT PRIMARY KEY,
    session TEXT NOT NULL,
    token_id TEXT,
    labels TEXT NOT NULL DEFAULT '[]',
    memory_bytes BIGINT NOT NULL DEFAULT 0,
    version TEXT NOT NULL DEFAULT '',
    locked BIGINT NOT NULL DEFAULT 0,
    draining BIGINT NOT NULL DEFAULT 0,
    sick_until BIGINT NOT NULL DEFAULT 0,
    last_seen BIGINT NOT NULL
);
CREATE INDEX worker_session ON worker (session);

CREATE TABLE worker_block (
    worker TEXT NOT NULL,
    job_id TEXT NOT NULL,
    n BIGINT NOT NULL,
    PRIMARY KEY (worker, job_id)
);
CREATE INDEX worker_block_job ON worker_block (job_id);

CREATE TABLE token (
    id TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL,
    role BIGINT NOT NULL,
    project TEXT,
    -- Set for the token of one worker: it registers under this name only
    worker TEXT,
    labels TEXT NOT NULL DEFAULT '[]',
    label TEXT NOT NULL,
    created_at BIGINT NOT NULL,
    expires_at BIGINT,
    revoked_at BIGINT,
    last_used_at BIGINT
);

CREATE TABLE ticket (
    id TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL,
    uses_left BIGINT NOT NULL,
    labels TEXT NOT NULL DEFAULT '[]',
    expires_at BIGINT NOT NULL
);

-- Which projects have uploaded what: equal hashes give no access across projects
CREATE TABLE asset (
    project TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    bytes BIGINT NOT NULL,
    created_at BIGINT NOT NULL,
    PRIMARY KEY (project, sha256)
);

-- What happened to jobs and workers; never a row for each batch
CREATE TABLE event (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    at BIGINT NOT NULL,
    kind TEXT NOT NULL,
    project TEXT NOT NULL,
    job_id TEXT,
    actor TEXT NOT NULL,
    payload TEXT NOT NULL
);
CREATE INDEX event_at ON event (at);

CREATE TABLE audit (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    at BIGINT NOT NULL,
    token_id TEXT,
    actor TEXT NOT NULL,
    address TEXT NOT NULL,
    action TEXT NOT NULL,
    status BIGINT NOT NULL
);
