-- How many days after a job's end its batches, parts and scene are kept, and what it published: for ever where nothing is said
ALTER TABLE project ADD COLUMN retention_days BIGINT NOT NULL DEFAULT 14;
ALTER TABLE project ADD COLUMN outputs_days BIGINT;

-- What is left of a job: 0 all of it, 1 it is being removed, 2 it is gone
ALTER TABLE job ADD COLUMN work_gone BIGINT NOT NULL DEFAULT 0;
ALTER TABLE job ADD COLUMN logs_gone BIGINT NOT NULL DEFAULT 0;
ALTER TABLE job ADD COLUMN outputs_gone BIGINT NOT NULL DEFAULT 0;
-- Whether the objects of claims that did not count are marked
ALTER TABLE job ADD COLUMN attempts_marked BIGINT NOT NULL DEFAULT 0;
-- A person has deleted it: it is not shown any more, and goes as a whole
ALTER TABLE job ADD COLUMN deleted BIGINT NOT NULL DEFAULT 0;

-- Batches whose rows are gone
ALTER TABLE pass ADD COLUMN kept_done BIGINT NOT NULL DEFAULT 0;
ALTER TABLE pass ADD COLUMN kept_failed BIGINT NOT NULL DEFAULT 0;
ALTER TABLE pass ADD COLUMN kept_skipped BIGINT NOT NULL DEFAULT 0;
CREATE INDEX pass_map ON pass (name) WHERE kind = 1;

-- Objects that nobody refers to: removed after a while, if that is still so
CREATE TABLE garbage (
    key TEXT PRIMARY KEY,
    bytes BIGINT NOT NULL,
    marked_at BIGINT NOT NULL
);

-- The assets of a job's scene. Jobs with the same files, such as the frames of a range, share a set
CREATE TABLE file_set (
    id TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (id, sha256)
);
CREATE INDEX file_set_sha256 ON file_set (sha256);
ALTER TABLE job ADD COLUMN file_set TEXT;
CREATE INDEX job_file_set ON job (file_set) WHERE file_set IS NOT NULL;
INSERT INTO file_set (id, sha256) SELECT DISTINCT job.id, f.value FROM job, json_each(job.request, '$.files') AS f;
UPDATE job SET file_set = id WHERE EXISTS (SELECT 1 FROM file_set WHERE file_set.id = job.id);
ALTER TABLE asset ADD COLUMN used_at BIGINT NOT NULL DEFAULT 0;
UPDATE asset SET used_at = created_at;
CREATE INDEX asset_sha256 ON asset (sha256);

-- Who does what only one coordinator should do at a time
CREATE TABLE leader (
    name TEXT PRIMARY KEY,
    holder TEXT NOT NULL,
    expires_at BIGINT NOT NULL
);
