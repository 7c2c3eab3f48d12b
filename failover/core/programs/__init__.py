"""Programs that are sent to robots: what a bundle holds, which may follow which, and the course of a switch; pure."""
