"""The operators' page: the team live in a browser, orders to it, and metrics for Prometheus; a process of its own.

Start reading in `page.app` (what is served) and `page.picture` (what is shown). It talks to the agent of its robot by the control
socket alone, and reads the board, the schedule and the names of drivers as any program of its user may. It imports `failover`,
and nothing imports it. `page.app` alone imports starlette, `page.serve` alone uvicorn.
"""
