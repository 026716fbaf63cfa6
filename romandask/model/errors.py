"""The one exception for a mistake that the user can mend."""

from __future__ import annotations


class UserError(Exception):
    """A wrong input: names the file, column or key, what was found and what to do.

    The command line prints it as one line and ends with exit code 2; nothing has been written.
    """
