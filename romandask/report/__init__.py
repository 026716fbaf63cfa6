"""Pages that show a stored survey: the report, the sky viewer, the stage diagram, the data-product reference."""
