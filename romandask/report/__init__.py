"""Pages about a survey: the report, the sky viewer, the stage diagram and the data-product reference."""
