"""What can go wrong with a folder of demonstrations, in sentences for its user."""


class DemonstrationsError(RuntimeError):
    """Demonstrations cannot be made, gone on with, or read; the message says why, and what to do."""
