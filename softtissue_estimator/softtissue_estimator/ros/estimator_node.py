"""The managed node `softtissue_estimator`: parameters, services, life cycle. The work is done elsewhere."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.logging import get_logger
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus, Structures
from softtissue_msgs.srv import DecideRegistration, Distance, LoadOrgan, Register, Reset, WarpPoints
from visualization_msgs.msg import MarkerArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.registration.pose_process import PoseProcess
from softtissue_estimator.ros import parameters
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.cloud_stream import CloudStream
from softtissue_estimator.ros.distances import (
    MOST_CALLS,
    ToolDistances,
    answer_distance,
    distances_message,
    refuse_distance,
)
from softtissue_estimator.ros.engine import load_engine, organ_roots
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.topic_quality import overridable
from softtissue_estimator.ros.inputs.transforms import tf_source
from softtissue_estimator.ros.managed import CONFIGURING, ManagedNode
from softtissue_estimator.ros.organ_loading import OrganLoading
from softtissue_estimator.ros.organ_registration import OrganRegistration
from softtissue_estimator.ros.organ_search import OrganSearch
from softtissue_estimator.ros.outputs.broadcast import RegistrationBroadcast
from softtissue_estimator.ros.outputs.status import Condition, diagnostics_message
from softtissue_estimator.ros.publishing import Outputs
from softtissue_estimator.ros.responder import Responder
from softtissue_estimator.ros.service_calls import ServiceCalls
from softtissue_estimator.ros.services import (
    MOST_WARPS,
    RESET_PERIOD_S,
    answer_warp,
    refuse_reset,
    refuse_warp,
)

NAME = "softtissue_estimator"
STOP_TIMEOUT_S = 2.0
OUTPUT_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# Kept for who comes later. Of markers only the newest: they are large.
KEPT = DurabilityPolicy.TRANSIENT_LOCAL
STATUS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=KEPT)
NEWEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=KEPT)


class EstimatorNode(ManagedNode):
    """Publishes where the inside of an organ is, many times a second.

    Parameters
    ----------
    on_crash : callable
        Takes an exception after which the process cannot go on; the program should end.

    Raises
    ------
    InvalidInputError
        If a parameter given at the start cannot be used.
    """

    def __init__(self, on_crash: Callable[[BaseException], None]) -> None:
        super().__init__(NAME, Boundary(get_logger(NAME), on_crash))
        parameters.declare_parameters(self)
        self._config: EstimatorConfig = parameters.read_config(self)
        self._counters = FrameCounters()
        self._registration = Registration(
            tf_source(self) if self._config.use_tf else None, lambda: self._config.registration_max_age_s
        )
        self._broadcast = RegistrationBroadcast(self)
        outputs = Outputs(
            self.create_lifecycle_publisher(PointCloud2, "~/deformed_points", **overridable(OUTPUT_QOS)),
            self.create_lifecycle_publisher(MarkerArray, "~/markers", **overridable(NEWEST_QOS)),
            self.create_lifecycle_publisher(
                PoseWithCovarianceStamped, "~/registration", **overridable(OUTPUT_QOS)
            ),
            self.create_lifecycle_publisher(EstimatorStatus, "~/status", **overridable(STATUS_QOS)),
            self.boundary.warn,
            self.boundary.sentence,
            self._broadcast,
            self.create_lifecycle_publisher(Structures, "~/structures", **overridable(NEWEST_QOS)),
            self.create_lifecycle_publisher(PointCloud2, "~/deformed_surface", **overridable(OUTPUT_QOS)),
            self.create_lifecycle_publisher(PointCloud2, "~/observed_points", **overridable(OUTPUT_QOS)),
        )
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", OUTPUT_QOS)
        self._poses = PoseProcess()
        self._search = OrganSearch(
            self._registration,
            lambda: self._config,
            self.boundary.sentence,
            self.boundary.info,
            self._poses,
            lambda organ: self._responder.elastic(organ),
        )
        self._responder = Responder(
            outputs, self._counters, self._registration, lambda: self._config, self._search
        )
        self._stream = CloudStream(
            self, self._responder, self._counters, self._registration, self.boundary, lambda: self._config
        )
        self._organ_loading = OrganLoading(self._responder, lambda: self._config, self.boundary)
        self._organ_registration = OrganRegistration(
            self._responder, self._registration, lambda: self._config, self.boundary, self._poses.find
        )
        self._warps = ServiceCalls("warp points", MOST_WARPS)
        self._distances = ServiceCalls("distance", MOST_CALLS)
        self._tool = ToolDistances(
            self,
            self.create_lifecycle_publisher(Distances, "~/tool_distances", OUTPUT_QOS),
            lambda tool: distances_message(
                tool, self._responder.answer, self._registration, self._config.no_data_timeout_s
            ),
            self.boundary.warn,
            lambda error: self.boundary.sentence("tool distances", error),
        )
        self._reset_s = -math.inf
        self._create_services()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(0.1, self._on_tenth, clock=steady)
        self.create_timer(1.0, self._on_second, clock=steady)
        # Last: the publishers declare parameters, too.
        self.add_on_set_parameters_callback(
            self.boundary.guarded("parameters", self._on_parameters, lambda said, _: parameters.refused(said))
        )

    def _create_services(self) -> None:
        # Their callbacks wait for threads; in a group that lets everything else go on meanwhile.
        waiting = ReentrantCallbackGroup()
        self.create_service(LoadOrgan, "~/load_organ", self._on_load_organ, callback_group=waiting)
        self.create_service(Register, "~/register", self._on_register, callback_group=waiting)
        self.create_service(DecideRegistration, "~/decide_registration", self._on_decide)
        self.create_service(WarpPoints, "~/warp_points", self._on_warp_points, callback_group=waiting)
        self.create_service(Distance, "~/distance", self._on_distance, callback_group=waiting)
        self.create_service(Reset, "~/reset", self._on_reset)

    # Life cycle

    @property
    def autostart(self) -> bool:
        """Whether the node starts without being asked."""
        return self._config.autostart

    def configure(self) -> None:
        """Load organ and estimator."""
        config = parameters.read_config(self)
        if config.organ != self._organ_loading.organ:
            # After `~/load_organ` they stay: organs beside the one that was configured can still be loaded.
            self._organ_loading.roots = organ_roots(config)
        self._config = config
        self._broadcast.use(config.broadcast_registration)
        self._responder.use(load_engine(config.organ, config, self.boundary.info, self._organ_loading.roots))

    def activate(self) -> None:
        """Begin to answer."""
        self._responder.reset()
        self._responder.describe()
        engine = self._responder.engine
        if engine is not None:
            self._search.prepare(engine.organ)
        self.boundary.info(f"answering clouds on {self._stream.open()}")

    def deactivate(self) -> None:
        """Stop answering; organ and estimator stay loaded."""
        self._stream.close(STOP_TIMEOUT_S)
        self._responder.reset()

    def clean_up(self) -> None:
        """Let go of organ and estimator."""
        self.deactivate()
        self._responder.use(None)

    def close(self, timeout_s: float) -> bool:
        """Stop working; return whether its threads ended in time."""
        return self._stream.stop_threads(timeout_s)

    # Timers

    def _on_tenth(self) -> None:
        self._stream.expire()
        self._responder.show_late_comers()

    def _on_second(self) -> None:
        self._stream.watch(self._config.no_data_timeout_s)
        now = self.get_clock().now().to_msg()
        failure = self.failure
        condition = Condition(
            self.state_label,
            "" if failure is None else self.boundary.words(failure),
            self.boundary.faults,
            self._registration.age_s,
            self._search.state,
        )
        self._diagnostics.publish(
            diagnostics_message(
                self.get_fully_qualified_name(),
                now,
                condition,
                self._responder.report,
                self._responder.setup,
                self._counters.counts,
            )
        )

    # Services

    async def _on_load_organ(
        self, request: LoadOrgan.Request, response: LoadOrgan.Response
    ) -> LoadOrgan.Response:
        response = await self._organ_loading.answer(request, response, self.executor)
        if response.result == LoadOrgan.Response.SUCCESS:
            # So that whoever asks the parameter, or cleans up and configures again, has the organ at work.
            self._config = dataclasses.replace(self._config, organ=request.folder)
            self.set_parameters([Parameter("organ", value=request.folder)])
        return response

    async def _on_register(self, request: Register.Request, response: Register.Response) -> Register.Response:
        stream = self._stream
        return await self._organ_registration.answer(
            request, response, stream.is_open, stream.newest, self.executor
        )

    def _on_decide(
        self, request: DecideRegistration.Request, response: DecideRegistration.Response
    ) -> DecideRegistration.Response:
        if not self._stream.is_open:
            response.result = DecideRegistration.Response.NOT_ACTIVE
            response.message = "expected an active node, got one that is not"
            return response
        return self._search.decide(request.decision, response)

    async def _on_warp_points(
        self, request: WarpPoints.Request, response: WarpPoints.Response
    ) -> WarpPoints.Response:
        active, answer = self._stream.is_open, self._responder.answer

        def warp() -> None:
            answer_warp(request, response, active, answer, self._registration)

        if not await self._warps.done(warp, self.executor):
            refuse_warp(response)
        return response

    async def _on_distance(self, request: Distance.Request, response: Distance.Response) -> Distance.Response:
        active, answer, timeout_s = (
            self._stream.is_open,
            self._responder.answer,
            self._config.no_data_timeout_s,
        )

        def measure() -> None:
            answer_distance(request, response, active, answer, self._registration, timeout_s)

        if not await self._distances.done(measure, self.executor):
            refuse_distance(response)
        return response

    def _on_reset(self, _request: Reset.Request, response: Reset.Response) -> Reset.Response:
        if not self._responder.configured:
            response.result = Reset.Response.NOT_CONFIGURED
            response.message = "expected an inactive or active node, got one that is not configured"
            return response
        since_last_s = time.monotonic() - self._reset_s
        if since_last_s < RESET_PERIOD_S:
            refuse_reset(response, since_last_s)
            return response
        self._reset_s = time.monotonic()
        self._stream.clear()
        self._responder.reset()
        return response

    # Parameters and log

    def _on_parameters(self, changes: list[Parameter]) -> Any:
        try:
            configured = self._responder.configured or self.state_label == CONFIGURING
            self._config = parameters.changed_config(self._config, changes, configured)
        except InvalidInputError as error:
            return parameters.refused(self.boundary.sentence("parameters", error))
        return parameters.accepted()
