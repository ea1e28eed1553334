"""A workflow over many photographs on running ComfyUI servers, through their HTTP API and websocket.

`workflow.py` is the workflow in a photograph's hands, `client.py` one server, `ledger.py` the folder of results,
`pool.py` the jobs that servers share, `worker.py` what happens on one server, `jobs.py` the whole run.
"""
