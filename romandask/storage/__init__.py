"""Files of a store, in a folder or an object store: paths, records, checksums, the lock."""
