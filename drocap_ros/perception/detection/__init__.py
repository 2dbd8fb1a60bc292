"""Person detection: letterbox, decoding of each layout, non-maximum suppression."""

from drocap_ros.perception.detection.detector import Detections, Detector

__all__ = ["Detections", "Detector"]
