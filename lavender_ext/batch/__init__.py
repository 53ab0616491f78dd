"""One call for one problem or for thousands: convert, solve and judge them, on threads without the interpreter lock."""
