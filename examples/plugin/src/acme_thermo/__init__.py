"""The Acme TC-4: a made-up thermometer. `driver` drives it, `sim` simulates it, and neither knows the other.

Its line: 9600 baud, 8N1. ``R3`` and a newline ask for everything, with a digit of one's own choice. The answer repeats
the digit, and has the model and the temperature of each probe in degC: ``3 TC-4 21.5 180.0*22``, where 22 is the
exclusive or of the bytes before the asterisk. ``?`` behind a temperature: the probe is beyond its -50 to 400 degC.
"""
