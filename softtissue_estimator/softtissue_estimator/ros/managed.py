"""A managed node whose transitions are reported, and which goes on answering services while it is configured."""

from collections.abc import Callable
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.bounded import BoundedNode, failed_response
from softtissue_estimator.ros.service_calls import ServiceCalls

SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)
UNCONFIGURED, CONFIGURING = "unconfigured", "configuring"


class ManagedNode(BoundedNode):
    """Runs the four steps of a node's life that a subclass fills: `configure`, `activate`, `deactivate`, `clean_up`.

    `configure` runs in a thread of its own, the others in the executor's: what is loaded takes seconds, during which
    `get_state` and parameters are answered.

    Parameters
    ----------
    name : str
    boundary : Boundary
    """

    def __init__(self, name: str, boundary: Boundary) -> None:
        super().__init__(name, boundary)
        self.failure: Exception | None = None
        self._configuring = ServiceCalls("configure", most=1)
        for service in self.services:
            if service.srv_type is ChangeState:
                self._serve_meanwhile(service)

    @property
    def state_label(self) -> str:
        """Name of the present state of the life cycle."""
        return str(self._state_machine.current_state[1])

    async def start(self) -> Exception | None:
        """Configure and activate, awaited in the executor; return what prevents it, which is in the log already."""
        done: list[TransitionCallbackReturn] = []
        taken = await self._configuring.done(lambda: done.append(self.trigger_configure()), self.executor)
        if taken and done == [SUCCESS] and self.trigger_activate() == SUCCESS:
            return None
        return self.failure or RuntimeError("the transition failed")

    def configure(self) -> None:
        """Make the node inactive."""

    def activate(self) -> None:
        """Make it active."""

    def deactivate(self) -> None:
        """Make it inactive again."""

    def clean_up(self) -> None:
        """Make it unconfigured."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load what is needed."""
        return self._transition(self.configure, super().on_configure, state, self.clean_up)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""

        def undo() -> None:
            self.deactivate()
            super(ManagedNode, self).on_deactivate(state)

        return self._transition(self.activate, super().on_activate, state, undo)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working; what is loaded stays loaded."""
        return self._transition(self.deactivate, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of what is loaded."""
        return self._transition(self.clean_up, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything."""
        return self._transition(self.clean_up, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured."""
        failure = self.failure
        result = self._transition(self.clean_up, super().on_error, state)
        self.failure = self.failure or failure
        return result

    def _transition(
        self,
        ours: Callable[[], None],
        entities: Callable[[LifecycleState], TransitionCallbackReturn],
        state: LifecycleState,
        undo: Callable[[], None] | None = None,
    ) -> TransitionCallbackReturn:
        """Run a transition; rclpy hides what its callbacks raise, so it is reported here.

        One that can be undone is a failure, after which the node is in the state it was in.
        """
        self.failure = None
        try:
            # The publishers begin before the work and end after it.
            if undo is None:
                ours()
                return entities(state)
            result = entities(state)
            ours()
            return result
        except Exception as error:
            self.failure = error
            said = self.boundary.sentence("transition", error)
            if isinstance(error, SoftTissueError):
                self.boundary.error(said)
            return ERROR if undo is None else self._undone(undo)

    def _undone(self, undo: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            undo()
        except Exception as error:
            self.boundary.sentence("transition", error)
            return ERROR
        return FAILURE

    def _serve_meanwhile(self, service: Any) -> None:
        """Let a service that changes the state configure in a thread, and everything else go on meanwhile."""
        changed = service.callback

        async def answered(request: Any, response: Any) -> Any:
            wanted = request.transition
            configures = wanted.label == "configure" or (
                not wanted.label and wanted.id == Transition.TRANSITION_CONFIGURE
            )
            if not configures or self.state_label != UNCONFIGURED:
                return changed(request, response)
            results: list[Any] = []
            taken = await self._configuring.done(
                lambda: results.append(changed(request, response)), self.executor
            )
            return results[0] if taken else response  # whose default is no success

        def failed(said: str, arguments: tuple[Any, ...]) -> Any:
            return failed_response(ChangeState, arguments[0], said)

        service.callback = self.boundary.guarded(service.service_name, answered, failed)
        # In a group of its own: while one callback of rclpy's usual group awaits something, no other of it may begin.
        service.callback_group = ReentrantCallbackGroup()
        service.callback_group.add_entity(service)
