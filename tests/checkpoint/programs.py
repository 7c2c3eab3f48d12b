"""Programs as they come with Debian, each computing for a second or two with output that is the same in every run."""

from __future__ import annotations

import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """One program.

    Attributes:
        argv: its words; relative file names lie in its working directory.
        files: what stands there before it starts.
        results: files that it leaves, besides its output.
        progress: the file whose growth shows how far it is.
        in_place: it writes into the middle of files, so it must not run on between capture and kill.
        environment: variables besides the usual ones.
        has_threads: it has several, which know each other by their ids.
    """

    name: str
    argv: tuple[str, ...]
    files: tuple[tuple[str, str], ...] = ()
    results: tuple[str, ...] = ()
    progress: str = "out"
    in_place: bool = False
    has_threads: bool = False
    environment: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        return self.name

    @property
    def needs(self) -> str:
        """The command that must be installed."""
        return self.argv[0]


PYTHON = """
import random, time
random.seed(7)
table = {}
for i in range(600):
    table[i] = random.random()
    print(i, sum(table.values()), flush=True)
    time.sleep(0.004)
"""
NUMPY = """
import time
import numpy as np
a = np.random.default_rng(7).random((120, 120))
for i in range(400):
    a = a @ a.T / 40 + np.sin(a)
    a /= np.abs(a).max()
    print(i, repr(float(a.sum())), flush=True)
    time.sleep(0.004)
"""
BC = "scale=300\nfor (i = 1; i < 360; i++) { a(1/i) }\nquit\n"
PERL = """
$| = 1; srand(7);
for my $i (1..600) {
    $h{$i} = rand(); my $s = 0; $s += $h{$_} for 1..$i;
    printf "%d %.6f\\n", $i, $s; select(undef, undef, undef, 0.004)
}
"""
GAWK = """BEGIN {
    srand(7)
    for (i = 0; i < 600; i++) { a[i] = rand(); s = 0; for (k = 0; k < 20000; k++) s += sin(k * a[i]); print i, s; fflush() }
}"""
# Some builds of mawk take their dice from arc4random(3), whatever the seed (Ubuntu's 1.3.4 20240123): no rand() here.
MAWK = """BEGIN {
    x = 0.4
    for (i = 0; i < 600; i++) {
        x = 3.9 * x * (1 - x); a[i] = x; s = 0
        for (k = 0; k < 20000; k++) s += sin(k * a[i])
        print i, s; fflush()
    }
}"""
LUA = """
local t = {}
for i = 1, 900 do
    t[#t + 1] = math.sin(i)
    local s = 0
    for k = 1, #t do for j = 1, 250 do s = s + t[k] * j end end
    print(i, s) io.flush()
end
"""
COUNTED = "(with recursive c(n) as (select 1 union all select n + 1 from c limit {}) select n from c)"
SQL = "create table t(i integer primary key, x text);\n" + "".join(
    f"insert into t select {i}, group_concat(n) from {COUNTED.format(60)};\n"
    f"select {i}, count(*), sum(length(x)) from t;\n"
    f"select sum(n) from {COUNTED.format(40000)};\n"
    for i in range(120)
)
OCTAVE = "x=ones(40); for i=1:300, x=x*x'; x=x/norm(x); printf('%d %.10g\\n', i, sum(x(:))); fflush(stdout); pause(0.004); end"

TCL = """
fconfigure stdout -buffering line
set x 5
for {set round 1} {$round <= 300} {incr round} {
    for {set i 0} {$i < 1500} {incr i} { set x [expr {($x * 16807 + $i) % 2147483647}]; set seen([expr {$x % 499}]) $i }
    puts "$round $x [array size seen] [string range [lsort [array names seen]] 0 30] [regexp -all {1.3} [array get seen]]"
}
"""

RUBY = """
$stdout.sync = true
x = 3; seen = Hash.new(0)
300.times do |round|
  12000.times { |i| x = (x * 48271 + i) % 2147483647; seen[(x % 701).to_s] += i }
  puts "#{round} #{x} #{seen.values.sum} #{seen.keys.sort.first(3).join(',')} #{(2**(round % 300)).to_s[0, 30]}"
end
"""

GUILE = """
(define (step x i) (modulo (+ (* x 48271) i) 2147483647))
(let rounds ((round 0) (x 3))
  (if (< round 400)
      (let inner ((i 0) (x x))
        (if (< i 12000) (inner (+ i 1) (step x i))
            (begin (display (list round x (modulo (expt x 7) 1000000007))) (newline) (force-output) (rounds (+ round 1) x))))))
"""

PYTHON_MIXED = """
import decimal, functools, hashlib, itertools, json, random, re, sys, zlib
decimal.getcontext().prec = 60
dice, digest, kept = random.Random(4), hashlib.sha256(), {}
pi = decimal.Decimal(0)
def walk(n):
    value = n
    while True:
        sent = yield value
        value = (value * 6364136223846793005 + (sent or 1)) % 2**64
walker = walk(9); next(walker)
@functools.lru_cache(maxsize=500)
def slow(n): return sum(int(c) for c in str(3 ** n))
for round in range(260):
    for _ in range(120):
        key = str(walker.send(round) % 499)
        kept.setdefault(key, []).append(dice.random())
    text = json.dumps({k: v[-3:] for k, v in sorted(kept.items())})
    digest.update(text.encode())
    pi += decimal.Decimal(1) / (2 * round + 1) * (-1) ** round
    found = len(re.findall(r'"(1\\d+)": \\[([^]]*?5[0-9]{3})', text))
    print(round, digest.hexdigest()[:16], found, pi, slow(round * 7), zlib.crc32(text.encode()), flush=True)
try:
    raise ValueError("last")
except ValueError as error:
    print("caught", error)
"""

PYTHON_FILES = """
import os
total = 0
with open("numbers.txt") as numbers, open("log.txt", "a") as log, open("blocks.bin", "r+b") as blocks:
    for count, line in enumerate(numbers):
        total = (total * 31 + int(line)) % 1000003
        log.write(f"{count} {total}\\n")
        if count % 40 == 0:
            log.flush()
            blocks.seek(total % 4000)
            blocks.write(total.to_bytes(4, "big"))
            blocks.flush()
            print(count, total, flush=True)
            for _ in range(20000): pass
"""

PHP = """
$x = 3; $seen = [];
for ($round = 0; $round < 300; $round++) {
    for ($i = 0; $i < 20000; $i++) { $x = ($x * 48271 + $i) % 2147483647; $seen["k" . ($x % 701)] = $i; }
    ksort($seen);
    printf("%d %d %s\\n", $round, $x, md5(implode(",", array_slice($seen, 0, 40))));
}
"""

SHELL = """
x=3; round=0
while [ $round -lt 300 ]; do
    i=0
    while [ $i -lt 400 ]; do x=$(((x * 48271 + i) % 2147483647)); i=$((i + 1)); done
    case $x in *7) word=seven ;; *) word=${x#?} ;; esac
    echo "$round $x $word"; round=$((round + 1))
done
"""

FORTH = """
variable x 3 x !
: step x @ 48271 * + 2147483647 mod x ! ;
: rounds 400 0 do 60000 0 do i step loop i . x @ . cr stdout flush-file throw loop ;
rounds bye
"""

DC = "[la 1 + dsa lb * 7 + 1000000007 % dsb p la 120000 >x] sx 0sa 12345sb lx x"
NUMBERS = "".join(f"{index * 7919 % 100003}\n" for index in range(30000))


PYTHON_THREADS = """
import queue, threading, hashlib
work, done = queue.Queue(maxsize=8), queue.Queue()
def worker():
    while (item := work.get()) is not None:
        digest = hashlib.sha256(str(item).encode())
        for _ in range(400):
            digest = hashlib.sha256(digest.digest())
        done.put((item, digest.hexdigest()))
        work.task_done()
threads = [threading.Thread(target=worker) for _ in range(4)]
for thread in threads:
    thread.start()
for round in range(150):
    for item in range(20):
        work.put(round * 20 + item)
    work.join()
    print(round, hash(tuple(sorted(int(done.get()[1][:12], 16) for _ in range(20)))), flush=True)
for _ in threads:
    work.put(None)
for thread in threads:
    thread.join()
print("the end", work.qsize(), done.qsize())
"""

NUMPY_POOL = """
import numpy as np
a = np.random.default_rng(7).random((160, 160))
for i in range(2_000):
    a = a @ a.T / 40 + np.sin(a)
    a /= np.abs(a).max()
    print(i, repr(float(a.sum())), flush=True)
"""

NODE = """
const crypto = require('crypto');
const table = new Map();
let digest = '7';
function round(count) {
  for (let i = 0; i < 800; i++) { digest = crypto.createHash('sha256').update(digest).digest('hex'); table.set(i, digest); }
  crypto.pbkdf2(digest, 'salt', 500, 24, 'sha256', (error, key) => {
    console.log(count, key.toString('hex'), table.size);
    if (count < 300) setTimeout(round, 5, count + 1);
  });
}
round(1);
"""


PLAIN = [
    Case("bc", ("bc", "-ql", "script.bc"), (("script.bc", BC),)),
    Case("cpython", (sys.executable, "script.py"), (("script.py", PYTHON),)),
    Case("numpy", (sys.executable, "script.py"), (("script.py", NUMPY),)),
    Case("perl", ("perl", "-e", PERL)),
    Case("gawk", ("gawk", GAWK)),
    Case("lua", ("lua", "-e", LUA)),
    Case("sqlite3", ("sqlite3", "t.db", ".read script.sql"), (("script.sql", SQL),), ("t.db",), in_place=True),
    Case("xz", ("xz", "-k", "-6", "-T1", "text"), (("text", "text"),), ("text.xz",), progress="text.xz"),
    Case("dc", ("dc", "-e", DC)),
    Case("mawk", ("mawk", MAWK)),
    Case("php", ("php", "-n", "-r", PHP)),
    Case("dash", ("dash", "script.sh"), (("script.sh", SHELL),)),
    Case("bash", ("bash", "--norc", "script.sh"), (("script.sh", SHELL),)),
    Case("gforth", ("gforth", "script.fs"), (("script.fs", FORTH),)),
    Case("tcl", ("tclsh", "script.tcl"), (("script.tcl", TCL),)),
    Case("cpython_libraries", (sys.executable, "script.py"), (("script.py", PYTHON_MIXED),)),
    Case(
        "cpython_files",
        (sys.executable, "script.py"),
        (("script.py", PYTHON_FILES), ("numbers.txt", NUMBERS), ("log.txt", "begin\n"), ("blocks.bin", "0" * 5000)),
        results=("log.txt", "blocks.bin"),
        in_place=True,
    ),
]

CASES = [
    *PLAIN,
    Case("ruby", ("ruby", "script.rb"), (("script.rb", RUBY),)),
    Case("guile", ("guile", "--no-auto-compile", "-s", "script.scm"), (("script.scm", GUILE),), has_threads=True),
    Case("octave", ("octave-cli", "-q", "--no-init-file", "--no-history", "--eval", OCTAVE), has_threads=True),
    Case("threads_of_cpython", (sys.executable, "script.py"), (("script.py", PYTHON_THREADS),), has_threads=True),
    Case(
        "pool_of_numpy",
        (sys.executable, "script.py"),
        (("script.py", NUMPY_POOL),),
        has_threads=True,
        environment=(("OPENBLAS_NUM_THREADS", "3"),),
    ),
    Case("node", ("node", "script.js"), (("script.js", NODE),), has_threads=True),
]
