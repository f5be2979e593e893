def demo(say):
    say("x")
