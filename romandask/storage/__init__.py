"""Store files, on a local disk or in an object store: paths, manifest records, checksums and the lock."""
