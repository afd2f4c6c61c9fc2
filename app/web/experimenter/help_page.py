"""The help page: how a study goes, and every word that these pages coin."""

from fastapi import APIRouter, Request
from fastapi.responses import Response

from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentExperimenter
from app.web.texts.templating import page

router = APIRouter(route_class=AuthorizedRoute)


@router.get("/help", name="show_help")
def show_help(request: Request, experimenter: CurrentExperimenter) -> Response:
    """How a study goes, and the glossary."""
    return page(request, "experimenter/help.html", {"experimenter": experimenter})
