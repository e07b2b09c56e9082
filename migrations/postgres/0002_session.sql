-- A browser's session is a token of its own, made from another by signing in; it ends with that one at the latest
ALTER TABLE token ADD COLUMN parent TEXT;
CREATE INDEX token_parent ON token (parent) WHERE parent IS NOT NULL;
