"""A local server for the planning page, which solves plans exactly as they are made."""

from cmfsim.planning.server.server import PlanningServer, open_port, serve_planning

__all__ = ["PlanningServer", "open_port", "serve_planning"]
