"""How our own processes start fast and stay small: late imports, parallel work, the allocator. Everything may import it."""
