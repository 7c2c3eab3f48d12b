"""What one robot says of the team: its view, what it noticed, what is promised now."""
