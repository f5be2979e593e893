"""The bench procedure, without screen, files or clock.

schema     procedure file
plan       shipped procedures, predicted accuracy, remaining steps
engine     state machine: samples and keys in, events and a view out
attempt    one attempt at a step
events     events and views of the engine
preflight  check of the sensors before the first step
prompts    text for the operator
"""
