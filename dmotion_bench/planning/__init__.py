"""Planning with a learned model: CEM, costs, the control loop."""
