"""Single-subject tracking: box filter, appearance, association, re-identification."""

from drocap_ros.perception.tracking.person import Subject
from drocap_ros.perception.tracking.subject import SubjectTracker

__all__ = ["Subject", "SubjectTracker"]
