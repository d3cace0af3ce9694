"""The model of the tippe top: bodies, arenas' frames in use, friction laws, launches, and the equations of motion.

A `Scene` holds a body, an arena, a friction law and gravity; its `dynamics` are the equations of slipping (`dynamics`), of
rolling, and of stick and slip with the onset of slip between them. Nothing here integrates anything.
"""
