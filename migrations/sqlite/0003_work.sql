-- A claim reads its segment's batches by their numbers
DROP INDEX batch_ready;
-- What is left of passes that were cancelled is found without a look at all that ever was
CREATE INDEX segment_ready ON segment (pass_id, seg) WHERE n_ready > 0;
