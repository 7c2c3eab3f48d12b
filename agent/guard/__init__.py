"""The guard's process, one for each component: parent of the program, its streams, its lease. It outlives the agent."""
