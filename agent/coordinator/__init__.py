"""etcd as a voter (``rule = "etcd"``): the process that speaks with it."""
