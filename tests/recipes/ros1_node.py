"""A ROS 1 node in Python: ``talker NAME`` publishes numbers on /chat, ``listener NAME`` prints what it hears there."""

import sys

import rospy
from std_msgs.msg import String

what, name = sys.argv[1:3]
rospy.init_node(name, disable_signals=True)


def heard(message: String) -> None:
    print(message.data, flush=True)


if what == "listener":
    rospy.Subscriber("chat", String, heard)
    print("ready", flush=True)
    rospy.spin()
else:
    publisher = rospy.Publisher("chat", String, queue_size=10)
    print("ready", flush=True)
    rate, count = rospy.Rate(20), 0
    while not rospy.is_shutdown():
        count += 1
        publisher.publish(String(str(count)))
        rate.sleep()
