"""The stages of a survey, one module or folder a product, each with its declaration."""
