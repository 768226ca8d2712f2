"""A local server for the planning page, which solves plans exactly as they are made."""

from cmfsim.planning.server.server import PlanningServer, check_serving, serve_planning

__all__ = ["PlanningServer", "check_serving", "serve_planning"]
