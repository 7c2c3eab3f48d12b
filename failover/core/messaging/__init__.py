"""Messages of programs and drivers: bytes, hops, and what an actor's mailbox promises; pure. For drivers and agent."""
