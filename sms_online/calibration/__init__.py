"""Calibration: what geometry, clocks and sensors may be off by within their tolerances, estimated beside π."""
