"""`lightprobe train mini`: the mini model and its rivals, stage by stage."""
