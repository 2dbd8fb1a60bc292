"""Person detection: letterbox, decoding of every layout, non-maximum suppression."""

from drocap_ros.perception.detection.detector import Detections, Detector

__all__ = ["Detections", "Detector"]
