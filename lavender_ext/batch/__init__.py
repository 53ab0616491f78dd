"""One call for one problem or for thousands: lay them out, solve and judge them, on threads without the interpreter."""
