"""Is this a mirror ball, and is this estimate to be relied on?"""
