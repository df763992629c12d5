"""Nodes and an executor whose every entity is inside the boundary, also those that rclpy adds itself."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from rcl_interfaces.msg import ParameterType, SetParametersResult
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.task import Future

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.boundary import Boundary

_LAST_PARAMETER_TYPE = int(ParameterType.PARAMETER_STRING_ARRAY)


class BoundedPlainNode(Node):
    """Puts the callback of every subscription, service and timer inside a boundary.

    Parameters
    ----------
    name : str
    boundary : Boundary
    """

    def __init__(self, name: str, boundary: Boundary) -> None:
        self.boundary = boundary  # first: rclpy makes services and subscriptions of its own at once
        super().__init__(name)
        for service in self.services:
            # Those of the life cycle are not made by `create_service`.
            if not hasattr(service.callback, "__wrapped__"):
                service.callback = self._answering(service.service_name, service.srv_type, service.callback)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Any:
        """Subscribe; a message whose callback fails is left."""
        guarded = self.boundary.guarded(topic, callback)
        return super().create_subscription(msg_type, topic, guarded, *arguments, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any
    ) -> Any:
        """Offer a service; a call whose callback fails is answered with a failure."""
        return super().create_service(
            srv_type, srv_name, self._answering(srv_name, srv_type, callback), **options
        )

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Any:
        """Make a timer; a call that fails is followed by the next one."""
        guarded = self.boundary.guarded("timer", callback)
        return super().create_timer(timer_period_sec, guarded, *arguments, **options)

    def _answering(self, name: str, srv_type: Any, callback: Callable[..., Any]) -> Callable[..., Any]:
        def failed(said: str, arguments: tuple[Any, ...]) -> Any:
            return failed_response(srv_type, arguments[0], said)

        if not hasattr(srv_type.Request(), "parameters"):
            return self.boundary.guarded(name, callback, failed)

        @wraps(callback)
        def with_known_types(request: Any, response: Any) -> Any:
            # All before the first is set: rclpy raises at the first of a type that it does not know.
            for parameter in request.parameters:
                if parameter.value.type > _LAST_PARAMETER_TYPE:
                    raise InvalidInputError(
                        f"parameter {parameter.name}: expected a type from 0 to {_LAST_PARAMETER_TYPE},"
                        f" got {parameter.value.type}"
                    )
            return callback(request, response)

        return self.boundary.guarded(name, with_known_types, failed)


class BoundedNode(BoundedPlainNode, LifecycleNode):
    """A managed node of that kind."""

    def destroy_node(self) -> None:
        """Leave the ROS graph at once."""
        super().destroy_node()
        # It holds what the node has in shared memory; rclpy leaves it to the interpreter's end.
        self._state_machine.destroy_when_not_in_use()


def failed_response(srv_type: Any, request: Any, sentence: str) -> Any:
    """Return what a service answers when its callback failed, never a default that means success."""
    response = srv_type.Response()
    refused = SetParametersResult(successful=False, reason=sentence)
    if hasattr(srv_type.Response, "INTERNAL_ERROR"):
        response.result, response.message = srv_type.Response.INTERNAL_ERROR, sentence
    elif hasattr(response, "results"):  # set_parameters
        response.results = [refused] * len(request.parameters)
    elif hasattr(response, "result") and isinstance(response.result, SetParametersResult):
        response.result = refused
    return response


class BoundedExecutor(SingleThreadedExecutor):
    """Leaves a message or call that cannot be taken from the middleware, as bytes that are none of its type.

    Without that rclpy would neither wait for its entity again nor let another of the same callback group work.

    Parameters
    ----------
    boundary : Boundary
    """

    def __init__(self, boundary: Boundary) -> None:
        super().__init__()
        self._boundary = boundary

    def create_future(self) -> Future:
        """Return a future whose callbacks this executor calls; executors of rclpy before Kilted have no such method."""
        return Future(executor=self)

    def _take_subscription(self, sub: Any) -> Any:
        return self._boundary.guarded(sub.topic_name, super()._take_subscription)(sub)

    def _take_service(self, srv: Any) -> Any:
        return self._boundary.guarded(srv.service_name, super()._take_service)(srv)

    def _take_client(self, client: Any) -> Any:
        return self._boundary.guarded("client", super()._take_client)(client)

    def _take_timer(self, tmr: Any) -> Any:
        return self._boundary.guarded("timer", super()._take_timer)(tmr)

    def _take_waitable(self, waitable: Any) -> Any:
        return self._boundary.guarded("event", super()._take_waitable)(waitable)
