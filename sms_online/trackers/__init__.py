"""Trackers: recursive estimators of π from rows of the balances."""

from sms_online.trackers.forgetting import Directional, Exponential, Forgetting, NoForgetting, SlidingWindow
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Estimate, Prior, Rows, Tracker
from sms_online.trackers.kalman import KalmanTracker
from sms_online.trackers.square_root import RecursiveLeastSquares

__all__ = [
    "Directional",
    "Estimate",
    "Exponential",
    "Forgetting",
    "Information",
    "KalmanTracker",
    "NoForgetting",
    "Prior",
    "RecursiveLeastSquares",
    "Rows",
    "SlidingWindow",
    "Tracker",
]
