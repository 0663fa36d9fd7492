"""What the operator's machinery asks: is it alive, is it ready, and how much does it do."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from prometheus_client.exposition import choose_encoder

from fleetmap import __version__
from fleetmap.transport.protocol import Problem
from fleetmap_server.http.answers import problem_answer
from fleetmap_server.metrics import ServerMetrics
from fleetmap_server.readiness import Readiness

_NOT_CACHED = {"Cache-Control": "no-store"}


def metrics_router(metrics: ServerMetrics) -> APIRouter:
    """``/metrics``, in OpenMetrics for those who ask for it and in Prometheus' text format for others."""
    router = APIRouter(tags=["operation"])

    @router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    def read(request: Request) -> Response:
        """What the server has done since it started, and how much it keeps."""
        encode, media_type = choose_encoder(request.headers.get("accept", ""))
        headers = {**_NOT_CACHED, "Content-Type": media_type, "Vary": "Accept"}
        return Response(encode(metrics.registry), headers=headers)

    return router


def health_router(readiness: Readiness) -> APIRouter:
    """``/healthz`` and ``/readyz``; both are for everybody, they tell nothing about maps."""
    router = APIRouter(tags=["operation"])

    @router.get("/healthz")
    def alive(response: Response) -> dict[str, Any]:
        """The process answers."""
        response.headers.update(_NOT_CACHED)
        return {"status": "ok", "version": __version__}

    @router.get("/readyz", response_model=dict[str, str])
    def ready() -> Any:
        """The catalogue and the store answer too; 503 with what does not."""
        failures = readiness.failures()
        if failures:
            return problem_answer(Problem(title="Not ready", status=503, detail="; ".join(failures)), _NOT_CACHED)
        return {"status": "ready"}

    return router
