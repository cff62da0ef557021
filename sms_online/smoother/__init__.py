"""The smoother that knows the dynamics: states and parameters of a span of a session, found together."""
