"""Nodes that hold something: a camera, networks, a file.  They follow ROS's life cycle (``ros2 lifecycle``).

``configure`` takes the resource, ``activate`` begins to work, ``deactivate`` is silence with the resource kept, and
``cleanup`` gives it back.  With parameter ``autostart`` (the default) the node takes the first two steps by itself, so
that a scripted bringup needs to know nothing of it.
"""

from __future__ import annotations

from typing import Any, ClassVar

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from drocap_ros.errors import DrocapError
from drocap_ros.parameters import Parameters
from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
#: Key of the state on ``/diagnostics``.
LIFECYCLE = "lifecycle"


class ManagedComponent(LifecycleNodeMixin, ComponentNode):
    """A component with a resource.

    A subclass declares its endpoints in its constructor, which ends with :meth:`set_up`, and says in
    :meth:`acquire`, :meth:`begin`, :meth:`pause` and :meth:`release` what the transitions mean.  Messages that come
    while it is not active are dropped.
    """

    #: A source waits for the other nodes; what only listens begins at once.
    begins_with_graph: ClassVar[bool] = False

    def __init__(self, config: Parameters | None = None, **node_kwargs: Any) -> None:
        ComponentNode.__init__(self, config, **node_kwargs)
        LifecycleNodeMixin.__init__(self)
        self.active = False
        self._failure: DrocapError | None = None
        self._autostart: bool = self.declare_parameter("autostart", True).value
        service = self._service_change_state
        change = service.callback

        def guarded(request: Any, response: Any) -> Any:
            # What the state does not allow is an error of the asker, not of this node.
            try:
                return change(request, response)
            except Exception as error:
                self.report(WARN, f"transition {request.transition.label or request.transition.id}: {error}")
                response.success = False
                return response

        service.callback = guarded

    # -- what a subclass does --------------------------------------------------------------------------

    def acquire(self) -> None:
        """Take the resource.

        Raises
        ------
        DrocapError
            When it cannot be had; the node then stays unconfigured.
        """

    def begin(self) -> None:
        """Begin to produce."""

    def pause(self) -> None:
        """Produce nothing more, and keep the resource."""

    def release(self) -> None:
        """Give the resource back; also called at the end, and then perhaps a second time."""

    # -- transitions -----------------------------------------------------------------------------------

    def set_up(self) -> None:
        """Last step of the constructor: with ``autostart``, configure, and activate unless the graph is waited for.

        Raises
        ------
        DrocapError
            What ``acquire`` raised.
        """
        self._tell("unconfigured")
        if self._autostart:
            self.trigger_configure()
            if self._failure is not None:
                raise self._failure
            if not self.begins_with_graph:
                self.trigger_activate()

    def on_start(self) -> None:
        """All peers are matched."""
        if self._autostart and self.begins_with_graph and not self.active:
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take the resource."""
        self._failure = None
        try:
            self.acquire()
        except DrocapError as error:
            self._failure = error
            self.report(ERROR, str(error))
            return FAILURE
        self._tell("inactive")
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        self.active = True
        self.begin()
        self.details[LIFECYCLE] = "active"
        self.report(OK, "running")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall silent."""
        self.active = False
        self.pause()
        self._tell("inactive")
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give the resource back."""
        self.release()
        self._tell("unconfigured")
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall silent and give the resource back, for good."""
        self.active = False
        self.release()
        self._tell("finalized")
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a transition that raised: give back what there is."""
        self.active = False
        self.release()
        self._tell("unconfigured")
        return SUCCESS

    def _tell(self, state: str) -> None:
        self.details[LIFECYCLE] = state
        if state != "active":
            self.report(OK, state)
