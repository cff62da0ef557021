"""What a model lacks: the residual of a session, the effect behind it, and what the effect changes."""
