"""The bench procedure, without screen, files or clock.

schema       procedure file
plan         shipped procedures, predicted accuracy, remaining steps
engine       state machine: samples and keys in, events and a view out
transitions  its table
phases       what happens in each phase
progress     state that the phases share
attempt      samples of one attempt at a step
events       actions, events and views
preflight    check of the sensors before the first step
prompts      what the operator has to do
"""
