"""Following one person among others: motion, look, search, choice."""

from drocap_ros.perception.tracking.subject import Subject, SubjectTracker

__all__ = ["Subject", "SubjectTracker"]
