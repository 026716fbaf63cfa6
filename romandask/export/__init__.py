"""Export of a survey to the file formats of other programs.

Each format is one module, which holds its public function, its writer and its command. `romandask.cli.export` finds the
commands (see `romandask.export.command`), so that a new format is one new module and nothing else.
"""
