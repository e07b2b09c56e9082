-- Who did it: when a worker is not believed any more, what it did is done again
ALTER TABLE batch ADD COLUMN worker TEXT;
-- Why the coordinator locked a worker
ALTER TABLE worker ADD COLUMN reason TEXT NOT NULL DEFAULT '';
