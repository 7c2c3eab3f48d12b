"""How a component moves or ends on purpose: handover, failback, promotion, exit."""
