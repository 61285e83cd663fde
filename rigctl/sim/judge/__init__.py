"""Which effects a scene calls for: facts of a survey, bounds, costs, and the plan that follows."""
