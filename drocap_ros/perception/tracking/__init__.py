"""Single-subject tracking: box filter, appearance, association, re-identification."""

from drocap_ros.perception.tracking.subject import Subject, SubjectTracker

__all__ = ["Subject", "SubjectTracker"]
