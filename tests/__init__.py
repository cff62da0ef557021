"""Tests, and the campaigns, recorded sessions and benchmarks beside them."""
