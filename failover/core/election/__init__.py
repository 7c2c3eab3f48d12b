"""Election of the robot that runs a component: consent of a pair, votes of a majority, leases."""
