"""Motions, recordings and running graphs in the Rerun viewer (``drocap view``).

``motion_view`` fills a :class:`~drocap_ros.view.rerun_scene.Scene` from a motion, ``message_view`` from messages of a
recording or of a running graph.
"""
