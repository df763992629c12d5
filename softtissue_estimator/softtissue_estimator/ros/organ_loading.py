"""The service `~/load_organ`: another organ is prepared in another process and takes the place of the one at work."""

import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softtissue_msgs.srv import LoadOrgan

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.engine import load_engine
from softtissue_estimator.ros.responder import Responder
from softtissue_estimator.ros.service_calls import ServiceCalls
from softtissue_estimator.support.memory import give_back, gone
from softtissue_estimator.support.sentences import one_sentence

_BUSY = "expected one organ at a time, got another call while one loads"
_NOT_CONFIGURED = "expected an inactive or active node, got one that is not configured"
_CHANGED = "expected a node that stays configured while an organ loads, got one that was cleaned up meanwhile"
_PATIENCE_S = 3.0  # several times what the old estimator's thread takes for a step


class OrganLoading:
    """Loads one organ at a time; a call that comes meanwhile is refused at once.

    Parameters
    ----------
    responder : Responder
    config : callable
        Returns the configuration as it is now.
    boundary : Boundary
        Takes what is going on, and errors.
    """

    def __init__(
        self, responder: Responder, config: Callable[[], EstimatorConfig], boundary: Boundary
    ) -> None:
        self._responder, self._config, self._boundary = responder, config, boundary
        self._calls = ServiceCalls("load organ", most=1)
        # Folder of the organ that was loaded last, if one was, and the folders outside of which none is read.
        self.organ: str | None = None
        self.roots: tuple[Path, ...] = ()

    async def answer(
        self, request: LoadOrgan.Request, response: LoadOrgan.Response, executor: Any
    ) -> LoadOrgan.Response:
        """Load the organ of a request."""

        def work() -> None:
            old = self._load(request.folder, response)
            if old is not None:
                gone(old, _PATIENCE_S)  # threads that were at work for it still hold it
            give_back()

        if not await self._calls.done(work, executor):
            _not_loaded(response, LoadOrgan.Response.BUSY, _BUSY)
        return response

    def _load(self, folder: str, response: LoadOrgan.Response) -> weakref.ref[Organ] | None:
        """Return the organ that is not needed any more, if there is one."""
        before = self._responder.engine
        if before is None:
            _not_loaded(response, LoadOrgan.Response.NOT_CONFIGURED, _NOT_CONFIGURED)
            return None
        try:
            engine = load_engine(folder, self._config(), self._boundary.info, self.roots, elsewhere=True)
        except SoftTissueError as error:
            said = self._boundary.sentence("load_organ", error)
            self._boundary.error(said)
            _not_loaded(response, LoadOrgan.Response.INVALID_ORGAN, said)
            return None
        self._responder.rehearse(engine)
        if self._responder.exchange(before, engine):
            self.organ = folder
            _loaded(response, engine.organ)
            return weakref.ref(before.organ)
        engine.estimator.close()
        _not_loaded(response, LoadOrgan.Response.NOT_CONFIGURED, _CHANGED)
        return weakref.ref(engine.organ)


def _loaded(response: LoadOrgan.Response, organ: Organ) -> None:
    response.result = LoadOrgan.Response.SUCCESS
    response.name = organ.name
    response.structures = len(organ.structures)
    response.vertices = len(organ.query_points)
    response.message = one_sentence(f"loaded {organ.name!r} with {len(organ.structures)} structures")


def _not_loaded(response: LoadOrgan.Response, result: int, message: str) -> None:
    response.result, response.message = result, message
