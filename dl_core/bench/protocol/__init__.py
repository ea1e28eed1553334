"""`lightprobe bench protocol`: the paper's protocols, on given maps or on maps painted for them."""
