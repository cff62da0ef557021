"""The verdict on a session: evidence, reasons, level of trust."""
