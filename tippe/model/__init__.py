"""The model of the tippe top: bodies, friction laws, launches, scenes, and the equations of motion.

A `Scene` holds a body, an arena, a friction law and gravity; its `dynamics` are the equations of slipping (`dynamics`),
of rolling, or of stick and slip with the onset of slip between them. Nothing in this room integrates.
"""
