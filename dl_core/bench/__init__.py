"""Measurements: what each stage of the method gains and loses, printed as tables and written as JSON."""
