"""Managed nodes (``ros2 lifecycle``): they hold a camera, networks or a file, or they are a source.

``configure`` acquires the resource, ``activate`` starts the work, ``deactivate`` stops the output and keeps the
resource, ``cleanup`` releases it, ``shutdown`` ends the node's work for good.  With parameter ``autostart`` (default)
a node configures and activates itself.  A source then waits until it is ready, and in a graph until the bringup
activates it; with parameter ``graph_running``, of a restarted node, it activates itself too.  A source that has ended
shuts down: its state is then ``finalized``.
"""

from __future__ import annotations

import threading
from functools import partial
from typing import ClassVar

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.rclpy_internals import answer_impossible_transitions, end_state_machine
from drocap_ros.ros.topics import NODES

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
#: Values of ``Key.LIFECYCLE`` on ``/diagnostics``, as ROS names its states.
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = "unconfigured", "inactive", "active", "finalized"

_WORDS = {
    UNCONFIGURED: "unconfigured: it holds nothing until it is configured",
    INACTIVE: "inactive: it publishes nothing until it is activated",
    ACTIVE: "running",
    FINALIZED: "finalized: its work has ended",
}


class ManagedComponent(ComponentNode, LifecycleNodeMixin):
    """A component with a life cycle.

    A subclass declares its endpoints in :meth:`build` and implements the transitions in :meth:`acquire`,
    :meth:`begin` and :meth:`release`.  Messages that arrive while it is not active are dropped.
    """

    component: ClassVar[str]

    def start_up(self) -> None:
        """Last step of the constructor: with ``autostart``, configure, and activate unless the node is a source.

        Raises
        ------
        Exception
            Raised by ``acquire``; a DrocapError when the resource is not available.
        """
        LifecycleNodeMixin.__init__(self)
        self.active = False
        self._is_source = NODES[self.component].source
        self._refusal: Exception | None = None
        self._ended = False
        self._autostart: bool = self.declare_parameter("autostart", True).value
        #: Whether the graph ran already, and this node in it.
        self.restarted = bool(self.declare_parameter("graph_running", False).value)
        self._activates_itself = self.restarted or not self.peers
        if self._is_source:
            self.create_timer(0.1, self._shut_down_when_ended)
        answer_impossible_transitions(self, partial(self.report, WARN))
        self.build()
        self._enter(UNCONFIGURED)
        if self._autostart:
            self.trigger_configure()
            if self._refusal is not None:
                raise self._refusal
            if not self._is_source:
                self.trigger_activate()

    # -- what a subclass implements --------------------------------------------------------------------

    def acquire(self) -> None:
        """Take the resource.

        Raises DrocapError when it is not available; the node then stays unconfigured.
        """

    def begin(self) -> None:
        """Start the output."""

    def release(self) -> None:
        """Release the resource; also called at the end, then perhaps a second time."""

    def close(self) -> None:
        """Release the resource."""
        self.release()

    def destroy_node(self) -> None:
        """Destroy the node with all that it has in DDS."""
        super().destroy_node()
        end_state_machine(self)

    # -- transitions -----------------------------------------------------------------------------------

    def on_ready(self) -> None:
        """Activate a source that no bringup activates."""
        if self._autostart and self._is_source and self._activates_itself and not self.active:
            self.trigger_activate()

    def end(self) -> None:
        """Note that the source has nothing left to publish; any thread may call this."""
        self._ended = True

    def _shut_down_when_ended(self) -> None:
        if self._ended:
            self._ended = False
            self.trigger_shutdown()

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Acquire the resource."""
        self._refusal = None
        try:
            self.acquire()
        except Exception as error:  # noqa: BLE001 -- rclpy would swallow it
            self._refusal = error
            self.report(ERROR, str(error))
            return FAILURE
        self._enter(INACTIVE)
        return SUCCESS

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Start the output."""
        self.active = True
        self.begin()
        self._enter(ACTIVE)
        return SUCCESS

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the output: messages are dropped, and a source's thread publishes nothing."""
        self.active = False
        self._enter(INACTIVE)
        return SUCCESS

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Release the resource."""
        self.release()
        self._ended = False
        self._enter(UNCONFIGURED)
        return SUCCESS

    def on_shutdown(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the output and release the resource for good."""
        self.active = False
        self.release()
        self._enter(FINALIZED)
        return SUCCESS

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """After a transition that raised: release the resource."""
        self.active = False
        self.release()
        self._enter(UNCONFIGURED)
        return SUCCESS

    def _enter(self, state: str) -> None:
        self.details[Key.LIFECYCLE] = state
        # The error that ended a source stays readable.
        if state != FINALIZED or self._level != ERROR:
            self.report(OK, _WORDS[state])
        self.publish_diagnostics()


class ThreadedSource(ManagedComponent):
    """A source whose thread, from the first activation on, executes :meth:`play`."""

    def start_up(self) -> None:
        """Last step of the constructor."""
        self.stopping = threading.Event()
        self._thread: threading.Thread | None = None
        super().start_up()

    def play(self) -> None:
        """Publish while the node is active, until the end or until ``stopping`` is set."""
        raise NotImplementedError

    def begin(self) -> None:
        """Start the thread; work under way has continued meanwhile."""
        if self._thread is None:
            self.stopping.clear()
            self._thread = self.thread(self.play, self.component)
            self._thread.start()

    def release(self) -> None:
        """End the thread."""
        self.stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            self._thread = None
