"""From any camera to one person's keypoints: sources, detection, subject tracking, 2D pose, uncertainty."""
