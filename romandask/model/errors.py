"""The exception for errors that the user can correct."""

from __future__ import annotations


class UserError(Exception):
    """An error in the user's input or settings.

    The message names the file, column or key, the value that was found, and what to do. The command line prints it as
    one line and exits with code 2; nothing has been written.
    """
