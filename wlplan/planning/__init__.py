"""Jobs, objectives, planners and what plays a plan."""
