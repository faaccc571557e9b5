"""The one error that a user can cause."""


class UserError(ValueError):
    """A user's mistake: its message is one line that says what is wrong, where, and what to do (exit code 2)."""
