"""The safety net: every number of some short sessions, recorded, so that code that moves one is noticed."""
