"""Nodes beside the estimator's that hear what it says: settings as parameters, subscriptions that bear any message."""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rclpy.logging import get_logger
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros import parameters
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.bounded import BoundedPlainNode
from softtissue_estimator.ros.command_line import Program

SettingsT = TypeVar("SettingsT")

# Of images, clouds and answers alike only the newest counts.
SENSOR_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
ANSWER_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
KEPT_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class ListenerNode(BoundedPlainNode, Generic[SettingsT]):
    """A node whose parameters are the fields of its program's settings.

    Parameters
    ----------
    program : Program
    fixed : frozenset of str
        Parameters that can only be given at the start.
    on_crash : callable
        Takes an exception after which the process cannot go on; the program should end.

    Attributes
    ----------
    settings : SettingsT
        Replaced as a whole where a parameter changes.

    Raises
    ------
    InvalidInputError
        If a parameter given at the start cannot be used.
    """

    def __init__(
        self, program: Program, fixed: frozenset[str], on_crash: Callable[[BaseException], None]
    ) -> None:
        name = f"softtissue_{program.name}"
        super().__init__(name, Boundary(get_logger(name), on_crash))
        parameters.warn_of_unknown(self, program)
        fields = dataclasses.fields(program.settings)
        for field in fields:
            parameters.declare(self, field.default, parameters.described(field, field.name in fixed))
        self.settings: SettingsT = program.settings(
            **{field.name: self.get_parameter(field.name).value for field in fields}
        )
        self._names = frozenset(field.name for field in fields)
        self.add_on_set_parameters_callback(
            self.boundary.guarded("parameters", self._on_parameters, lambda said, _: parameters.refused(said))
        )

    def listen(self, kind: Any, topic: str, take: Callable[[Any], None], qos: QoSProfile) -> Any:
        """Subscribe; of a message that cannot be used a sentence is logged.

        Parameters
        ----------
        kind : type of message
        topic : str
        take : callable
            Takes a message; may raise InvalidInputError.
        qos : QoSProfile
        """

        def on_message(message: Any) -> None:
            try:
                take(message)
            except InvalidInputError as error:
                self.boundary.warn(str(error))

        return self.create_subscription(kind, topic, on_message, qos)

    def _on_parameters(self, changes: list[Parameter]) -> Any:
        values: dict[str, Any] = {
            change.name: change.value for change in changes if change.name in self._names
        }
        try:
            self.settings = dataclasses.replace(self.settings, **values)  # type: ignore[type-var]
        except InvalidInputError as error:
            return parameters.refused(self.boundary.sentence("parameters", error))
        return parameters.accepted()
