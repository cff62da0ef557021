"""Views of a running session in rerun: what is handed over, what is drawn, and where it goes.

The estimator's side is `session.py` (`open_view`); everything that touches rerun lives in a process of its own.
"""
