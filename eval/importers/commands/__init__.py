"""Commands as the flight log has them: motors in order, throttle and set points made rates."""
