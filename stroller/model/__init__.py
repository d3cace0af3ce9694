"""The model of the stroller: the vehicle, its scene, friction laws, inputs, launches, and the equations of motion."""
