"""What the user did wrong, said in one line; apps turn it into exit status 2."""

from __future__ import annotations


class UserError(Exception):
    """A mistake in the user's input: the message names the file, the field and the remedy, without a line break."""
