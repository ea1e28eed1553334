"""`lightprobe bench pareto`: error against cost over schedules, and the chart that comes along."""
