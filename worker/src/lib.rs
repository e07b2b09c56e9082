//! The farm worker: claims batches, traces them, uploads parts. Not built yet.
