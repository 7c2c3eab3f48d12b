"""Status of the team as one robot sees it: its view, its observations, the promise that holds now."""
