"""Planned moves and ends of a component: handover, failback, promotion, exit."""
