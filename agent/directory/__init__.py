"""The process that asks the organisation's directory (LDAP) who a user is. Only the worker starts it and talks to it."""
