"""The Rerun viewer's window on a motion, a recording or a running graph: the room behind ``drocap view``.

One :class:`~drocap_ros.view.scene.Scene` holds what is drawn and where; ``motion_view``, ``session_view`` and the live
command fill it, the latter two through the same ``message_view``.
"""
