"""Running the units of stages: what is stale, on which workers, with which progress, log and checks."""
