"""The planning page served on this machine: plans are solved exactly while they are made."""

from cmfsim.planning.server.server import PlanningServer, check_serving, serve_planning

__all__ = ["PlanningServer", "check_serving", "serve_planning"]
