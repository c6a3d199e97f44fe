"""Errors of the wire: one line each, saying what, where, what was expected and what was found."""


class MessageError(ValueError):
    """Base of everything a message, topic or transport can refuse."""


class DecodeError(MessageError):
    """A frame that is malformed, oversized, of another version or out of range."""


class EncodeError(MessageError):
    """A value that its message type does not allow."""


class TransportError(MessageError):
    """An endpoint that can't be bound, connected or is not allowed."""
