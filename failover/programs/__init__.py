"""Programs that are sent to robots: packed, signed, admitted, run confined, and switched under load."""
