"""Numbers for Prometheus, for whoever has the operator's token."""

from collections.abc import Iterable
from hmac import compare_digest
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Header, Request
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from app.db import complaints
from app.errors import AppError
from app.services.monitoring import gauges
from app.services.monitoring.gauges import Gauge
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import Studio, StudioDep

router = APIRouter(route_class=AuthorizedRoute)


class NoMetrics(AppError):
    """There is no page at this address."""

    status = HTTPStatus.NOT_FOUND


@router.get("/metrics", name="show_metrics", include_in_schema=False)
def show_metrics(request: Request, studio: StudioDep, authorization: Annotated[str, Header()] = "") -> Response:
    """In the text format of Prometheus. Without METRICS_TOKEN, or with another one, there is no such page."""
    token = studio.settings.metrics_token
    if token is None or not compare_digest(authorization.encode(), f"Bearer {token}".encode()):
        raise NoMetrics
    of_now = CollectorRegistry()
    of_now.register(_Families(_gauges(studio)))
    content = generate_latest(request.app.state.metrics) + generate_latest(of_now)
    return Response(content, headers={"content-type": CONTENT_TYPE_LATEST})


def _gauges(studio: Studio) -> list[Gauge]:
    found = list(gauges.of_machine(studio.settings.data_dir, studio.database.url, studio.store))
    try:
        with studio.database.reading() as session:
            found += gauges.of_studies(session)
    except SQLAlchemyError as error:
        complaints.error("no metrics of studies: %s", error)
        return [*found, _database_answers(0.0)]
    return [*found, _database_answers(1.0)]


def _database_answers(value: float) -> Gauge:
    return Gauge("studio_database_answers", "1: the database could be read; 0: it could not.", value)


class _Families(Collector):
    """Gauges of one name together, as the format wants them."""

    def __init__(self, found: Iterable[Gauge]) -> None:
        self._found = list(found)

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """See Collector."""
        families: dict[str, GaugeMetricFamily] = {}
        for gauge in self._found:
            family = families.setdefault(
                gauge.name, GaugeMetricFamily(gauge.name, gauge.help, labels=list(gauge.labels))
            )
            family.add_metric(list(gauge.labels.values()), gauge.value)
        return families.values()
