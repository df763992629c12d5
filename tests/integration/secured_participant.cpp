// A DDS participant with the keys of an enclave, or none, for test_security_keys.py. It needs Fast DDS 2 with security.
//
// secured_participant DOMAIN FOLDER may            reads lines "publish TOPIC" and "subscribe TOPIC", answers yes or no
// secured_participant DOMAIN FOLDER publish TOPIC VALUE    writes the value ten times a second until it is ended
// secured_participant DOMAIN FOLDER hear TOPIC            prints each value that it hears, once; ends 2 s after the first
//
// FOLDER is that of the enclave, or "-" for a participant without security.
#include <chrono>
#include <iostream>
#include <memory>
#include <set>
#include <string>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/log/Log.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/types/DynamicDataFactory.h>
#include <fastrtps/types/DynamicPubSubType.h>
#include <fastrtps/types/DynamicTypeBuilderFactory.h>
#include <fastrtps/types/DynamicTypeBuilderPtr.h>

using namespace eprosima::fastdds::dds;
using namespace eprosima::fastrtps::types;

namespace {

// What rmw_fastrtps sets, from the files that `ros2 security` makes.
void secure(DomainParticipantQos& qos, const std::string& folder) {
    const std::string authentication = "dds.sec.auth.builtin.PKI-DH.";
    const std::string access = "dds.sec.access.builtin.Access-Permissions.";
    auto& properties = qos.properties().properties();
    properties.emplace_back("dds.sec.auth.plugin", "builtin.PKI-DH");
    properties.emplace_back("dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC");
    properties.emplace_back("dds.sec.access.plugin", "builtin.Access-Permissions");
    const std::string place = "file://" + folder + "/";
    properties.emplace_back(authentication + "identity_ca", place + "identity_ca.cert.pem");
    properties.emplace_back(authentication + "identity_certificate", place + "cert.pem");
    properties.emplace_back(authentication + "private_key", place + "key.pem");
    properties.emplace_back(access + "permissions_ca", place + "permissions_ca.cert.pem");
    properties.emplace_back(access + "governance", place + "governance.p7s");
    properties.emplace_back(access + "permissions", place + "permissions.p7s");
}

[[noreturn]] void leave(int code) {
    std::cout.flush();
    std::_Exit(code);
}

}  // namespace

int main(int, char** arguments) {
    Log::ClearConsumers();  // each refusal is one of its errors, on stdout
    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    const auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    transport->interfaceWhiteList.push_back("127.0.0.1");  // on this machine only
    qos.transport().user_transports.push_back(transport);
    qos.transport().use_builtin_transports = false;
    const std::string folder = arguments[2];
    if (folder != "-") {
        secure(qos, folder);
    }
    auto* const participant =
        DomainParticipantFactory::get_instance()->create_participant(std::stoi(arguments[1]), qos);
    if (participant == nullptr) {
        std::cerr << "no participant: are the keys in order?\n";
        leave(3);
    }
    auto* const factory = DynamicTypeBuilderFactory::get_instance();
    auto* const builder = factory->create_struct_builder();
    builder->add_member(0, "value", factory->create_int32_type());
    builder->set_name("Value");
    const auto type = builder->build();
    TypeSupport support(new DynamicPubSubType(type));
    support.get()->auto_fill_type_information(false);
    support.get()->auto_fill_type_object(false);
    support.register_type(participant);
    auto* const publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    auto* const subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    auto* const data = DynamicDataFactory::get_instance()->create_data(type);

    const std::string task = arguments[3];
    std::string act = task == "publish" ? "publish" : "subscribe", name;
    while (task == "may" ? static_cast<bool>(std::cin >> act >> name) : name.empty()) {
        if (task != "may") {
            name = arguments[4];
        }
        auto* topic = dynamic_cast<Topic*>(participant->lookup_topicdescription(name));
        if (topic == nullptr) {
            topic = participant->create_topic(name, "Value", TOPIC_QOS_DEFAULT);
        }
        auto* const writer =
            act == "publish" ? publisher->create_datawriter(topic, DATAWRITER_QOS_DEFAULT) : nullptr;
        auto* const reader =
            act == "publish" ? nullptr : subscriber->create_datareader(topic, DATAREADER_QOS_DEFAULT);
        if (task == "may") {
            std::cout << (writer != nullptr || reader != nullptr ? "yes" : "no") << std::endl;
        } else if (writer != nullptr) {
            data->set_int32_value(std::stoi(arguments[5]), 0);
            while (true) {
                writer->write(data);
                std::this_thread::sleep_for(std::chrono::milliseconds(100));
            }
        } else if (reader != nullptr) {
            auto end = std::chrono::steady_clock::now() + std::chrono::seconds(60);
            std::set<int> heard;
            SampleInfo info;
            while (std::chrono::steady_clock::now() < end) {
                while (reader->take_next_sample(data, &info) == ReturnCode_t::RETCODE_OK) {
                    int value = 0;
                    data->get_int32_value(value, 0);
                    if (info.valid_data && heard.insert(value).second) {
                        std::cout << value << std::endl;
                        if (heard.size() == 1) {
                            end = std::chrono::steady_clock::now() + std::chrono::seconds(2);
                        }
                    }
                }
                std::this_thread::sleep_for(std::chrono::milliseconds(20));
            }
        }
    }
    leave(0);
}
