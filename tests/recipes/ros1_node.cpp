// A ROS 1 node in C++: "listener NAME" prints what it hears on /chat.
#include <cstdio>

#include <ros/ros.h>
#include <std_msgs/String.h>

static void heard(const std_msgs::String::ConstPtr &message) {
    std::printf("%s\n", message->data.c_str());
    std::fflush(stdout);
}

int main(int count, char **words) {
    ros::init(count, words, words[2], ros::init_options::NoSigintHandler);
    ros::NodeHandle node;
    ros::Subscriber subscriber = node.subscribe("chat", 10, heard);
    std::puts("ready");
    std::fflush(stdout);
    ros::spin();
}
