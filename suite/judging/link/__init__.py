"""Flies a policy in real time over MAVLink, on a real vehicle or a simulated one (`suite fly`).

The link connects the vehicle with the companion computer, which runs the policy: `companion.py` is
one end, `simulated.py` the other one, `messages.py` and `udp.py` are in between.
"""
