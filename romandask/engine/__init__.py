"""Engine: find stale units, run them on workers, report progress, write the event log and verify the store."""
