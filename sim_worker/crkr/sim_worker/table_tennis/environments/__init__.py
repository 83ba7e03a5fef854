"""How a swing is executed: contact, hybrid and analytic."""
