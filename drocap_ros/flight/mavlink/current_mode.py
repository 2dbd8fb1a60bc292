"""CURRENT_MODE (message 436), which pymavlink 2.4.50 does not have: the present and the intended mode.

An autopilot that refuses an interval for HEARTBEAT may grant one for this message, which it sends twice a second and
after every change: a mode of the pilot is seen after one interval, not after the second between two heartbeats.
Registered with pymavlink, it is decoded like any other message: checksum, truncated zeros and signature included.
Source: MAVLink's common.xml, https://mavlink.io/en/messages/common.html#CURRENT_MODE.
"""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

CURRENT_MODE_ID = 436


class CurrentMode(mavlink.MAVLink_message):
    """The message, as pymavlink's generator would write it.

    Parameters
    ----------
    standard_mode : MAV_STANDARD_MODE, 0 = none of them
    custom_mode : as in HEARTBEAT
    intended_custom_mode : the mode that was chosen last, and that the vehicle may enter as soon as it can; 0 = unknown
    """

    id = CURRENT_MODE_ID
    msgname = "CURRENT_MODE"
    fieldnames = ("standard_mode", "custom_mode", "intended_custom_mode")
    orders = (2, 0, 1)  # of the fields in the payload, which has the longest first
    lengths = (1, 1, 1)
    crc_extra = 193
    unpacker = struct.Struct("<IIB")

    def __init__(self, standard_mode: int, custom_mode: int, intended_custom_mode: int) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self.standard_mode = standard_mode
        self.custom_mode = custom_mode
        self.intended_custom_mode = intended_custom_mode

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet's bytes by this encoder; its sequence number is not advanced."""
        payload = self.unpacker.pack(self.custom_mode, self.intended_custom_mode, self.standard_mode)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


mavlink.mavlink_map.setdefault(CURRENT_MODE_ID, CurrentMode)  # a later pymavlink has its own
