"""The preview's choice of poses."""

import dataclasses

import numpy as np

from drocap_ros.report.preview import shown_frames


def test_poses_are_those_of_frames_with_the_person(person):
    keypoints = person.keypoints.copy()
    keypoints[:40] = np.nan
    np.testing.assert_array_equal(
        shown_frames(dataclasses.replace(person, keypoints=keypoints)), [40, 43, 46, 50, 53, 56, 59]
    )
    without = dataclasses.replace(person, keypoints=np.full_like(keypoints, np.nan))
    assert shown_frames(without)[[0, -1]].tolist() == [0, 59]
